"""Zhang, Han, Lian and Zeng (2017): set filters under hidden and pairwise Markov models."""
