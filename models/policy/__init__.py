"""A small policy: it clones demonstrations from the states of robot and environment and from pictures, and predicts chunks of actions."""
