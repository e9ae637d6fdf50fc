"""Photos in the viewport: the best photo of a fruit, and backgrounds behind cameras."""
