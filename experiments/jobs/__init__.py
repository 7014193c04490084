"""What trainings and tunings share: resumable jobs, checkpoints, paths and seeds."""
