"""What fits the numbers that counting weighs with."""
