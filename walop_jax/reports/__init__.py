"""Results turned into figures and pages. Nothing is computed here that a fit or a diagnosis would need."""
