"""From a capture session to a packed dataset: masks, boxes, packing."""
