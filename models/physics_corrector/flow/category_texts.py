"""What a text encoder is given of a scene: the categories of its objects and the kind of its table, in plain words."""

from stable_data.scene import Scene


def category_texts(scene: Scene) -> list[str]:
    """Returns the categories of a scene's objects, in order, and last the kind of its table."""
    return [name.replace("_", " ") for name in (*(o.category for o in scene.objects), scene.table.table_type)]
