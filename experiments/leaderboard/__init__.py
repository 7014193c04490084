"""Leaderboard: rows of results folders that anybody hands in, with reruns of a sample of each."""
