"""The synthetic highway world, written in the TruckScenes layout (see `write.ensure_world`)."""
