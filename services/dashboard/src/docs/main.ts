// The REST API's reference at /docs, from the service's own /openapi.json; nothing comes from other hosts.

import SwaggerUI from "swagger-ui-dist/swagger-ui-es-bundle.js";
import "swagger-ui-dist/swagger-ui.css";

SwaggerUI({ url: "/openapi.json", dom_id: "#api", deepLinking: true, validatorUrl: null });
