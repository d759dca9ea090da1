"""The synthetic highway world, written in the TruckScenes layout (see `write.write_world`)."""
