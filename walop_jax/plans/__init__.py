"""Plans of calibration exposures with a proof of how good they are."""
