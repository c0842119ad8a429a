// In place of the 3D view where the browser cannot draw one: all the rest of the page works.
import { element } from "../dom";
import type { Viewer } from "../viewer/types";

/** A viewer that draws nothing; `host` says why. */
export function withoutView(host: HTMLElement, why: string): Viewer {
  const note = element("p", { class: "note no-view" }, why);
  host.replaceChildren(note);
  const nothing = (): void => undefined;
  return {
    ...{ reset: nothing, addPoints: nothing, setPointColours: nothing, setPointSize: nothing },
    ...{ setMappingCameras: nothing, showMappingCameras: nothing, highlight: nothing },
    ...{ showPoses: nothing, setTrail: nothing, setCoverage: nothing },
    ...{ overview: nothing, flyTo: nothing, setTheme: nothing },
    statistics: { pointsLoaded: 0, pointsDrawn: 0, framesPerSecond: null, firstPictureMs: null },
    extent: null,
    viewpoint: { position: [0, 0, 0], target: [0, 0, 0] },
    dispose: () => note.remove(),
  };
}
