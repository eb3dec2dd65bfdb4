"""The dual system: Algorithm 1 of the paper for one scene, and its batched execution for many scenes."""
