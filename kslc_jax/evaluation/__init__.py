"""Judging a policy: commands that hold or change, disturbances, robots that differ, metrics of the
gait, and the bars. Imports no training."""
