"""Pinocchio: model, engine, reader."""
