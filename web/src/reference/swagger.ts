// What the service serves at /docs: its routes, which can be tried.
import SwaggerUI from "swagger-ui-dist/swagger-ui-es-bundle.js";
import "swagger-ui-dist/swagger-ui.css";

SwaggerUI({
  url: "openapi.json",
  dom_id: "#api",
  validatorUrl: null, // the default asks another host
});
