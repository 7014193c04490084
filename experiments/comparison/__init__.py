"""Comparisons of agents, or of folders of results, drive by drive with their intervals."""
