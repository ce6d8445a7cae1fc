"""Zhang (2011): servoing with Kalman, particle and unscented Kalman estimates of the image Jacobian."""
