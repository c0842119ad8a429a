// Photos that are dropped anywhere on the page, or pasted.

/** `overlay` shows that the page takes what is being dragged. */
export function takePhotos(
  overlay: HTMLElement,
  onPhotos: (photos: { photo: Blob; name: string }[]) => void,
): void {
  const filesOf = (data: DataTransfer | null): { photo: Blob; name: string }[] =>
    [...(data?.files ?? [])].map((file) => ({ photo: file, name: file.name }));
  const hasFiles = (event: DragEvent): boolean =>
    event.dataTransfer?.types.includes("Files") ?? false;

  addEventListener("dragenter", (event) => {
    if (hasFiles(event)) overlay.hidden = false;
  });
  addEventListener("dragover", (event) => {
    if (!hasFiles(event)) return;
    event.preventDefault(); // else the browser would open the file
    event.dataTransfer!.dropEffect = "copy";
  });
  addEventListener("dragleave", (event) => {
    // Out of the window, not from one element to the next.
    if (event.relatedTarget === null) overlay.hidden = true;
  });
  addEventListener("drop", (event) => {
    overlay.hidden = true;
    if (!hasFiles(event)) return;
    event.preventDefault();
    onPhotos(filesOf(event.dataTransfer));
  });
  addEventListener("paste", (event) => {
    const photos = filesOf(event.clipboardData);
    if (photos.length === 0 || isForField(event)) return;
    event.preventDefault();
    onPhotos(photos);
  });
}

/**
 * Whether text is pasted, or into a field. Spreadsheets and word processors give a picture of a text
 * along with it, in both of its forms; a file's name comes as plain text only, a web page's picture
 * with its markup only.
 */
function isForField({ target, clipboardData }: ClipboardEvent): boolean {
  const types = clipboardData?.types ?? [];
  const isText = types.includes("text/plain") && types.includes("text/html");
  return isText || (target instanceof Element && target.closest("input, textarea") !== null);
}
