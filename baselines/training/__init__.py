"""Training of learned agents. The only room that imports torch and Stable-Baselines3."""
