"""Predicted contacts of any gains on any known surface, with an interval, alone and beside those of a log."""
