"""The arm servos: one physical world behind features, pixels, single and vector environments."""
