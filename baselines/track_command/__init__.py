"""`servotrack track`: a real sequence in; tracks, an annotated film and scores out."""
