"""What a fit has learnt of an instrument: the calibration, its product file, its matrix, its fitness for use."""
