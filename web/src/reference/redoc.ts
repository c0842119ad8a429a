// What the service serves at /redoc: its routes, to be read.
import Redoc from "redoc/bundles/redoc.standalone.js";

Redoc.init("openapi.json", { nativeScrollbars: true }, document.getElementById("api"));
