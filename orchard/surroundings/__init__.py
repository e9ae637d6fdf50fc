"""What surrounds the tree: distractors, objects and neighbouring trees."""
