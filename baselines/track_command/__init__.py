"""`servotrack track`: track people in a real sequence, and write tracks, an annotated video and scores."""
