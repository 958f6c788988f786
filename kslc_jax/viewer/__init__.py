"""The live viewer, gait strips and films of a policy. Imports no training code."""
