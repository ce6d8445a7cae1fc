"""Wu and Hu (2010): the GM-PHD filter on video, repeated on a rendered sequence."""
