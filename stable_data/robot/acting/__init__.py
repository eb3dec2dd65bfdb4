"""Who acts in an environment: the expert, whose episodes are recorded, or a policy; and how often it succeeds."""
