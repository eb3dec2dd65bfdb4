"""The import job: source folders of assets become a library that ``--assets`` takes."""
