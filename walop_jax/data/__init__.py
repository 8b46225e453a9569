"""Calibration sets, tables of users and filters: columns, units, checks, merging, optical design programs.

This room turns files into plain immutable records and back. Units are checked at the door and are
gone afterwards: inside the package a number has the unit that the record's docstring gives.
"""
