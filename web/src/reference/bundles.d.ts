// The bundles bring no types of their own.
declare module "swagger-ui-dist/swagger-ui-es-bundle.js" {
  export default function SwaggerUI(options: {
    url: string;
    dom_id: string;
    validatorUrl: null;
  }): void;
}

declare module "redoc/bundles/redoc.standalone.js" {
  const Redoc: {
    init(url: string, options: { nativeScrollbars: boolean }, element: Element | null): void;
  };
  export default Redoc;
}
