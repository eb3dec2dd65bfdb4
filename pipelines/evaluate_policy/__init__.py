"""The evaluate-policy job: a policy acts in environments of scenes, and its success is counted."""
