"""Public board: frozen suites, submissions of agents with their action traces, and their verification by replay."""
