"""Physical limits of lane changes and laps, by optimal control."""
