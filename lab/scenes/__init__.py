"""Made scenes with known truth: furniture, light, cameras and photographs of rooms that a seed draws."""
