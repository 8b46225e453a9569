"""Files: opened, checked, written whole or not at all. Nothing here knows what a calibration set is."""
