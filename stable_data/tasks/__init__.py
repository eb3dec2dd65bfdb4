"""Tasks with a checkable goal: conditions on the state of a scene, compiled from its task info, and a shaped reward."""
