"""Paper 000 (Wu and Hu 2010): the GM-PHD filter on video, its experiment run again on a rendered sequence."""
