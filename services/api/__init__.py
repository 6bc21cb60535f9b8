"""The REST API: scenes, assets and the state of the processes, over HTTP. `app.create_app` creates it."""
