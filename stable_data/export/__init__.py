"""Export formats, one module each; :mod:`stable_data.export.formats` lists them."""
