"""UncalibServo: one simulated arm world behind the feature and pixel environments, single and vectorized."""
