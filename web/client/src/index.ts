export { connect, type Client, type Settings } from "./client.js";
export { ownError, ServiceError, type Problem } from "./errors.js";
export {
  blended,
  cameraMatrix,
  sessionFromMap,
  type Axes,
  type Matrix4,
  type Posed,
} from "./frames.js";
export { parsePoints, PointsError, ROW_BYTES, type PointBlock } from "./points.js";
export {
  localizeForm,
  type FeatureArray,
  type Features,
  type GnssPrior,
  type LocalizeCall,
  type Photo,
  type Priors,
  type RigCall,
  type RigImage,
  type SequenceCall,
  type SequenceInstant,
} from "./requests.js";
export * from "./words.js";
