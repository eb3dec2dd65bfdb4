"""A small policy: it clones demonstrations from the states of robot and environment, and predicts chunks of actions."""
