"""PedestrianServo: an arm's camera over a walking crowd. The tracker's estimate decides where the camera looks next."""
