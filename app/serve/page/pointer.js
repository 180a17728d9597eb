// Mouse, pen and fingers on a canvas, reported as clicks, strokes, drags and zooms: of the labelling page, and of the page of a scene, which
// this file stands in without the word that exports.

const kStill_px = 4;

/// Calls: hover(x, y) or hover(null); down(x, y), draw(x, y, event), up(isClick, x, y, event), cancel(isPinch) of the left button, a pen or one
/// finger; pan(dx, dy) of the right or middle button or two fingers; zoom(factor, x, y, event of the wheel), `wheel_px` of the wheel for a factor of e;
/// scrolls(): whether the wheel is the page's. Points are CSS pixels of the element.
export function followPointer(element, calls) {
  const pointers = new Map();
  let mode = null;  // 'draw', 'pan' or 'pinch'
  let start = null;
  let moved = false;

  const at = (event) => {
    const box = element.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  };
  const pair = () => {
    const [a, b] = [...pointers.values()];
    return {x: (a[0] + b[0]) / 2, y: (a[1] + b[1]) / 2, apart: Math.max(1, Math.hypot(a[0] - b[0], a[1] - b[1]))};
  };

  element.addEventListener('pointerdown', (event) => {
    if (event.pointerType !== 'touch' || !calls.scrolls?.()) element.focus({preventScroll: true});
    event.preventDefault();
    try { element.setPointerCapture(event.pointerId); } catch { /* gone already */ }
    pointers.set(event.pointerId, at(event));
    if (pointers.size === 2) {
      if (mode === 'draw') calls.cancel?.(true);
      mode = 'pinch';
      start = pair();
    } else if (pointers.size === 1) {
      const drags = event.button === 1 || event.button === 2 || (event.button === 0 && event.altKey);
      mode = drags ? 'pan' : event.button === 0 ? 'draw' : null;
      start = at(event);
      moved = false;
      if (mode === 'draw') calls.down(...start);
    }
  });

  element.addEventListener('pointermove', (event) => {
    const point = at(event);
    if (!pointers.has(event.pointerId)) {
      if (event.pointerType !== 'touch') calls.hover?.(...point);
      return;
    }
    const before = pointers.get(event.pointerId);
    pointers.set(event.pointerId, point);
    if (mode === 'pinch' && pointers.size === 2) {
      const now = pair();
      calls.pan(now.x - start.x, now.y - start.y);
      calls.zoom(now.apart / start.apart, now.x, now.y);
      start = now;
    } else if (mode === 'pan') {
      calls.pan(point[0] - before[0], point[1] - before[1]);
    } else if (mode === 'draw') {
      moved ||= Math.hypot(point[0] - start[0], point[1] - start[1]) > kStill_px;
      if (moved) {
        for (const step of event.getCoalescedEvents?.() ?? []) calls.draw(...at(step), event);
        calls.draw(...point, event);
      }
      calls.hover?.(...point);
    }
  });

  const ended = (event) => {
    if (!pointers.delete(event.pointerId)) return;
    if (event.type === 'pointerup') element.focus({preventScroll: true});  // a swipe that scrolls ends with pointercancel
    if (mode === 'draw') {
      if (event.type === 'pointerup') calls.up(!moved, ...at(event), event);
      else calls.cancel?.(false);
      mode = null;
    }
    if (pointers.size === 0) mode = null;  // a finger of a pinch that stays does not draw
    if (event.pointerType === 'touch') calls.hover?.(null);
  };
  element.addEventListener('pointerup', ended);
  element.addEventListener('pointercancel', ended);
  element.addEventListener('pointerleave', () => calls.hover?.(null));
  element.addEventListener('contextmenu', (event) => event.preventDefault());
  element.addEventListener('wheel', (event) => {
    if (calls.scrolls?.()) return;
    event.preventDefault();
    const lines = event.deltaMode === 1 ? 30 : event.deltaMode === 2 ? 300 : 1;
    const step = Math.max(-240, Math.min(240, event.deltaY * lines));
    calls.zoom(Math.exp(-step / (event.ctrlKey ? 120 : calls.wheel_px ?? 400)), ...at(event), event);
  }, {passive: false});
}
