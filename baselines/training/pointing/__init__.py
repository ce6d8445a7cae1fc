"""A sensor that sees a third of the region and is pointed: is there a decision worth learning?"""
