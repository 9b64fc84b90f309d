"""Drake: model, engine, reader."""
