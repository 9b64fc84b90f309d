"""MuJoCo: model, engine, native rollouts, reader and writer of MJCF."""
