"""Looking at a policy: the live viewer, gait strips and films. Imports no training."""
