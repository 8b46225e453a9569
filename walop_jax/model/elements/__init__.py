"""The elements of a train, a class each; `registry` lists the kinds that a description file may name."""
