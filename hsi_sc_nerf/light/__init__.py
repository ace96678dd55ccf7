"""Light on the object, told apart from the material because the light stands still and the object turns."""
