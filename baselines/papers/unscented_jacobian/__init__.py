"""Paper 002: servoing by Kalman, particle and unscented Kalman estimates of the image Jacobian."""
