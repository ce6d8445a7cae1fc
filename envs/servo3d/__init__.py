"""A serial arm of any number of joints with an uncalibrated camera, in hand or in the world."""
