"""Lower bounds on the travel of every allocation, with proofs."""
