"""Hidden Markov models on grids: forward-backward smoothing, Viterbi paths and existence, for one or many chains.

    chain = grid_chain(positions=721, rates=np.arange(-2.0, 2.1, 0.5), spacing=0.25)
    smoothed = smooth(chain, likelihood)  # likelihood ratios, shape (rows, 721)
    there = presence(smoothed.existence_likelihood)
    print(spans(there), smoothed.marginal.reshape(-1, 9, 721).sum(axis=1).argmax(axis=1))

`smooth` is the forward-backward recursion and `presence` the sequential test of existence. `sparse_chain` makes a chain
from any sparse transition matrix.
"""

from servotrack.estimators.hmm.chain import Chain, GridChain, grid_chain, sparse_chain
from servotrack.estimators.hmm.exclusion import exclude, occupancy
from servotrack.estimators.hmm.existence import Span, presence, spans
from servotrack.estimators.hmm.smoothing import Smoothed, advance, smooth
from servotrack.estimators.hmm.viterbi import best_path

__all__ = [
    "Chain",
    "GridChain",
    "Smoothed",
    "Span",
    "advance",
    "best_path",
    "exclude",
    "grid_chain",
    "occupancy",
    "presence",
    "smooth",
    "spans",
    "sparse_chain",
]
