"""Shared parts of trainings and tunings: resumable jobs, checkpoints, paths and seeds."""
