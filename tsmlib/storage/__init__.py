"""Files: artefacts, tables, manifests, provenance."""
