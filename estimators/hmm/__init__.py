"""Hidden Markov models on grids: forward-backward smoothing, best paths and existence, for one or many chains."""
