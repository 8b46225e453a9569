"""Instruments as data: description files, read and checked. What their elements do is the business of the model."""
