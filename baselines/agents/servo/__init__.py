"""Servo agents: online estimators of the image Jacobian with a control law, behind `predict`."""
