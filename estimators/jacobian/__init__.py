"""Online estimation of the total image Jacobian (paper 002), and the control laws that use it."""
