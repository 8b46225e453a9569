"""Calibration sets, catalogues and filters: columns, units, checks, merging, exports of optical design programs.

This room turns files into plain immutable records and back. Units are checked at the door and are
gone afterwards: inside the package a number has the unit that the record's docstring gives.
"""
