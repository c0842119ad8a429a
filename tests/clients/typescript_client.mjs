// What the TypeScript client gets from a service: {"url", "map", "camera", "photos"} comes as one
// line of JSON, and {"localized": ..., ...} goes out.
import { readFile } from "node:fs/promises";
import { text } from "node:stream/consumers";
import { cameraMatrix, connect, sessionFromMap } from "../../web/client/dist/index.js";

const given = JSON.parse(await text(process.stdin));
const client = connect(given.url, { timeoutSeconds: 60 });
const photos = await Promise.all(given.photos.map((path) => readFile(path)));
const { map, camera } = given;

/** The code and field of what a call is refused with. */
const refusal = (call) =>
  call.then(
    () => null,
    ({ code, field }) => ({ code, field }),
  );

const answer = await client.localize({
  map,
  image: new Uint8Array(photos[0]),
  camera,
});
const matrix = cameraMatrix(answer.pose, "opengl");
const rig = await client.localizeRig({
  map,
  rig: given.rig,
  images: photos.map((photo, i) => ({
    sensor: `cam${i}`,
    image: new Blob([photo]),
  })),
});
// Each photo alone, a second apart, and one between the first two that shows nothing.
const single = (photo, i) => [
  { image: new Uint8Array(photo), camera: given.rig.sensors[`cam${i}`].camera },
];
const walk = photos.slice(0, 2).map((photo, i) => ({ timestamp: 2 * i, images: single(photo, i) }));
const gap = { timestamp: 1, images: [{ image: new Blob([]), camera }] };
const sequence = [];
const instants = [walk[0], gap, walk[1]];
const asked = {
  map,
  instants,
  time_unit: "s",
  max_gap_s: 5,
};
for await (const each of client.localizeSequence(asked)) sequence.push(each);

/** Answers that came, and the error after them; at most `most` are asked for. */
async function sequenceUntil(call, most = Infinity, signal = undefined) {
  const answers = [];
  try {
    for await (const each of client.localizeSequence({ map, time_unit: "s", ...call }, signal)) {
      answers.push(each.status);
      if (answers.length === most) break;
    }
  } catch ({ code, field, message }) {
    return { answers, code, field, message };
  }
  return { answers };
}
const bad = [{ image: new Blob(["no photo"]), camera }];
const [listed] = await client.maps();
const points = await client.points(map, 0, 100);
const images = await client.images(map, 0, 2);
const aborted = new AbortController();
aborted.abort(new Error("given up"));

process.stdout.write(
  JSON.stringify({
    answer,
    matrix,
    identity: sessionFromMap(matrix, answer.pose, "opengl"),
    rig,
    sequence,
    sequences: {
      left: await sequenceUntil({ instants }, 1),
      disordered: await sequenceUntil({ instants: [walk[1], walk[0]] }),
      unknown: await sequenceUntil({ map: "nowhere", instants }),
      aborted: await sequenceUntil({ instants }, 9, AbortSignal.abort(new Error("given up"))),
      photo: await sequenceUntil({
        max_gap_s: 0,
        instants: [walk[0], { timestamp: 1, images: bad }],
      }),
    },
    maps: { listed: listed.id, asked: (await client.map(map)).landmarks },
    points: {
      total: points.total,
      count: points.count,
      bytes: points.rows.byteLength,
    },
    images: images.images.length,
    options: Object.keys(await client.options()),
    refused: {
      map: await refusal(client.localize({ map: "nowhere", image: photos[0] })),
      camera: await refusal(
        client.localize({
          map,
          image: photos[0],
          camera: { ...camera, params: [1] },
        }),
      ),
      photo: await refusal(client.localize({ map, image: new Blob(["no photo"]) })),
      aborted: await client.maps(aborted.signal).catch((error) => error.message),
      elsewhere: await refusal(connect("http://127.0.0.1:9").maps()),
    },
  }),
);
