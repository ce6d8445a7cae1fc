"""How fast the worlds and filters are beside others, and whether the agents reach the figures that were asked for."""
