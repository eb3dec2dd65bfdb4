"""The commands of ``stable-data``, by what they are about."""
