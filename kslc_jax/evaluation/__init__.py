"""Judging a trained policy: changing commands, disturbances, robots that differ, and the bars."""
