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
    if (photos.length === 0) return; // text, for a field
    event.preventDefault();
    onPhotos(photos);
  });
}
