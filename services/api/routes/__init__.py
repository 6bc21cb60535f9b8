"""The routes of the REST API: one module per kind of resource, each with its `ROUTERS`."""
