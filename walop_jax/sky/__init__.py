"""The full-Moon sky, the turn from the sky to the instrument frame, and nights."""
