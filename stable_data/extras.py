"""The optional packages of the library, and what a person is told where one of them is missing."""

EXTRA_OF_MODULE = {
    **dict.fromkeys(("fast_simplification", "fcl", "igl", "manifold3d", "networkx", "scipy"), "geometry,sim"),
    **dict.fromkeys(("shapely", "threadpoolctl", "trimesh", "vhacdx", "mujoco", "PIL", "OpenGL"), "geometry,sim"),
    "gymnasium": "geometry,sim,env",
    "torch": "torch",
    **dict.fromkeys(("peft", "safetensors", "tensorboard", "transformers"), "geometry,models"),
    **dict.fromkeys(("jsonschema", "ray"), "geometry,sim,pipelines"),
}
"""What to install where a module is missing: all that its users need, so that a person installs once."""


def install_hint(error: ModuleNotFoundError) -> str | None:
    """Which module is missing and the command that installs it, in one line.

    Args:
        error: What an import raised.

    Returns:
        None where the module belongs to no extra.
    """
    missing = (error.name or "").partition(".")[0]
    extra = EXTRA_OF_MODULE.get(missing)
    return f"needs {missing}, which is not installed: pip install 'stable-data[{extra}]'" if extra else None
