"""Light on the object, separated from its material: the light is stationary while the object turns."""
