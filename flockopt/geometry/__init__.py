"""One distance model, in numpy and compiled, and proofs that hold between samples."""
