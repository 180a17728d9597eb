// Where an image lies on the screen: fitted, zoomed about a point, dragged. Pure; lengths on the screen are CSS pixels.

const kMargin = 8;
const kMostZoom = 40;

/// scale: screen pixels per image pixel; (x, y): the screen's point of the image's upper left corner.
export function fitted(image, screen) {
  const scale = Math.max(1e-6, Math.min((screen.width - 2 * kMargin) / image.width, (screen.height - 2 * kMargin) / image.height));
  return {scale, x: (screen.width - scale * image.width) / 2, y: (screen.height - scale * image.height) / 2};
}

export const toImage = (port, x, y) => [(x - port.x) / port.scale, (y - port.y) / port.scale];
export const toScreen = (port, x, y) => [port.x + x * port.scale, port.y + y * port.scale];
export const isInside = (image, x, y) => x >= 0 && y >= 0 && x < image.width && y < image.height;

/// Zoomed by `factor`; the image's point under (x, y) stays there. Never smaller than fitted.
export function zoomed(port, factor, x, y, image, screen) {
  const least = fitted(image, screen);
  const scale = Math.min(Math.max(port.scale * factor, least.scale), Math.max(kMostZoom, least.scale));
  if (scale <= least.scale * 1.001) return least;
  const ratio = scale / port.scale;
  return kept({scale, x: x - (x - port.x) * ratio, y: y - (y - port.y) * ratio}, image, screen);
}

export const moved = (port, dx, dy, image, screen) => kept({...port, x: port.x + dx, y: port.y + dy}, image, screen);

/// Moved as little as leaves the image in sight: its middle third never leaves the screen.
function kept(port, image, screen) {
  const within = (at, length, most) => Math.min(Math.max(at, most / 3 - length), (most * 2) / 3);
  return {...port, x: within(port.x, port.scale * image.width, screen.width), y: within(port.y, port.scale * image.height, screen.height)};
}
