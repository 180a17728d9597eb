// Photographs and overlays of views: fetched when a view is looked at, kept for the last few.
import {getBlob, photoAddress} from './api.js';
import {kEntropyColors} from './colors.js';

const kKept = 16;

/// A map that forgets what was used longest ago.
class Recent {
  constructor(most) {
    this.most = most;
    this.values = new Map();
  }
  get(key) {
    const value = this.values.get(key);
    if (value !== undefined) {
      this.values.delete(key);
      this.values.set(key, value);
    }
    return value;
  }
  set(key, value) {
    this.values.delete(key);
    this.values.set(key, value);
    if (this.values.size > this.most) this.values.delete(this.values.keys().next().value);
  }
  delete(key) { this.values.delete(key); }
  all() { return this.values.values(); }
}

/// The grey picture of entropy in colours.
export function entropyCanvas(bitmap) {
  const canvas = new OffscreenCanvas(bitmap.width, bitmap.height);
  const context = canvas.getContext('2d', {willReadFrequently: true});
  context.drawImage(bitmap, 0, 0);
  const image = context.getImageData(0, 0, bitmap.width, bitmap.height);
  for (let i = 0; i < image.data.length; i += 4) image.data.set(kEntropyColors[image.data[i]], i);
  context.putImageData(image, 0, 0);
  return canvas;
}

export class Pictures {
  /// changed(): something that may be shown has come; trouble(error).
  constructor(channel, changed, trouble) {
    Object.assign(this, {channel, changed, trouble});
    this.photos = new Recent(kKept);
    this.overlays = new Recent(kKept);
    this.wished = null;
  }

  /// name: of the photograph, which is another when the scene was changed and the program started again.
  photo(view, name) {
    const known = this.photos.get(view);
    if (known?.name === name) return known.bitmap;
    const entry = {name, bitmap: null};
    this.photos.set(view, entry);
    getBlob(photoAddress(view, name)).then(createImageBitmap).then((bitmap) => {
      entry.bitmap = bitmap;
      this.changed();
    }, (error) => {
      if (this.photos.get(view) === entry) this.photos.delete(view);
      this.trouble(error);
    });
    return null;
  }

  /// {labels, entropy, color, revision, full...} of the view, or null; older than the newest while that is fetched.
  overlay(view) { return this.overlays.get(view) ?? null; }

  /// Everything may be another: the program was started anew.
  forget() {
    for (const entry of this.overlays.all()) Object.assign(entry, {revision: -1, entropyRevision: -1, colorRevision: -1});
    this.wished = null;
  }

  /// Asks for what is missing or old. wish: {view, entropy, color}; `revision` of the newest label maps; `pause_ms` between renderings.
  want({view, entropy, color}, revision, pause_ms) {
    const entry = this.overlays.get(view);
    const fresh = (at) => at !== undefined && at >= revision;
    const rested = performance.now() - (entry?.colored_ms ?? -Infinity) > pause_ms;
    const needsColor = color && (!entry?.color || (!fresh(entry.colorRevision) && rested));
    if (entry && fresh(entry.revision) && (!entropy || fresh(entry.entropyRevision)) && !needsColor) return;
    const key = `${view} ${entropy} ${needsColor} ${revision}`;
    if (this.wished === key) return;
    this.wished = key;
    const request = {view, labels: true, entropy, color: needsColor, full: false};
    this.channel.wish(request, (picture) => this.took(view, picture), (error) => {
      setTimeout(() => { if (this.wished === key) { this.wished = null; this.changed(); } }, 1000);
      this.trouble(error);
    });
  }

  took(view, picture) {
    this.wished = null;
    if (!picture.stale) {
      const entry = this.overlays.get(view) ?? {};
      const revision = picture.overlay_revision;
      Object.assign(entry, {revision, labels: picture.labels ?? entry.labels ?? null});
      if (picture.entropy) Object.assign(entry, {entropy: entropyCanvas(picture.entropy), entropyRevision: revision});
      if (picture.color) Object.assign(entry, {color: picture.color, colorRevision: revision, colored_ms: performance.now()});
      entry.version = (entry.version ?? 0) + 1;
      this.overlays.set(view, entry);
    }
    this.changed();
  }
}
