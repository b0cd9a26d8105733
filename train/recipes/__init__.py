"""Training that goes on from given weights, with more places and the mean of both."""
