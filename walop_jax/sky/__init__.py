"""The full-Moon sky and the turn from the sky to the instrument frame: astropy's second door."""
