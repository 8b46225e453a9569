"""Finding what the model lacks: the alarm, the name, the addition, and what it honestly cannot tell."""
