"""The only public port: login, the page's files, the document's websocket, uploads, downloads, and viser behind it."""
