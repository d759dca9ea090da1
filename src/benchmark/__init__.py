"""What things cost: time, arithmetic and memory of the model's parts, of its operations and of training."""
