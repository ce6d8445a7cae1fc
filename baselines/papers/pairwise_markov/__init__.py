"""Paper 004 reproduced: set filters under hidden and pairwise Markov models."""
