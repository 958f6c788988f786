"""Trials of a policy: constant and changing commands, disturbances, varied robots, metrics of the
gait, and the bars. Imports no training code."""
