"""The arm's camera over a walking crowd: the world in which tracking decides what is seen next."""
