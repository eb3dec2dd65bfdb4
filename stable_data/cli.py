"""The command line of the library: ``stable-data VERB``."""

import typer

from stable_data.commands import exports, installation, judging, publishing, runs, scene_files, worlds

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Tabletop scenes as data. The Ray jobs (preprocess, generate, correct, ...) are `python -m pipelines` in a checkout.",
)


@app.callback()
def main() -> None:
    """Tabletop scenes as data: make, audit, inspect, select, export."""


for _group in (worlds, runs, publishing, judging, exports, scene_files, installation):
    app.add_typer(_group.app)
