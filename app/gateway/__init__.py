"""The only public port: who may enter, the page, the document, uploads, exports, and viser behind it."""
