"""Judging a policy: trials under fixed commands and the metrics of a gait. Imports no training."""
