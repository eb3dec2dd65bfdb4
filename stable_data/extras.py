"""The optional packages of the library, and the installation hint for a missing one."""

EXTRA_OF_MODULE = {
    **dict.fromkeys(("fast_simplification", "fcl", "igl", "manifold3d", "networkx", "scipy"), "geometry,sim"),
    **dict.fromkeys(("shapely", "threadpoolctl", "trimesh", "vhacdx", "mujoco", "PIL", "OpenGL"), "geometry,sim"),
    **dict.fromkeys(("collada", "pxr"), "geometry,sim,import"),
    "gymnasium": "geometry,sim,env",
    "viser": "geometry,sim,view",
    "lance": "lance",
    "sapien": "geometry,sim,sapien",
    "pydrake": "geometry,sim,drake",
    "torch": "torch",
    **dict.fromkeys(("peft", "safetensors", "tensorboard", "transformers"), "geometry,models"),
    **dict.fromkeys(("jsonschema", "ray"), "geometry,sim,pipelines"),
}
"""Module -> extras to install if it is missing: all that users of the module need, so that one installation is enough."""


def install_hint(error: ModuleNotFoundError) -> str | None:
    """Returns the module that an import misses and the command that installs it, in one line; None if it belongs to no extra."""
    missing = (error.name or "").partition(".")[0]
    extra = EXTRA_OF_MODULE.get(missing)
    return f"needs {missing}, which is not installed: pip install 'stable-data[{extra}]'" if extra else None
