"""Foreign formats: one module each, one ``write`` each; :mod:`stable_data.export.formats` lists them."""
