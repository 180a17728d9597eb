// Keys of the whole page, left to the control that has the focus where it needs them itself.

/// Keys that the focused element handles.
function isTaken(event) {
  const {target, key} = event;
  if (target.matches('input[type="text"], select, textarea')) return true;
  if (target.matches('input[type="range"]')) return /^(Arrow|Home|End|Page)/.test(key);
  if (target.closest('button, a, summary')) return key === ' ' || key === 'Enter';
  return false;
}

/// 'shift+z', 'ctrl+z', 'ArrowLeft', ' ', '1', 'shift+1' (of the key itself, not of what shift makes of it).
export function nameOfKey(event) {
  const digit = /^Digit([1-9])$/.exec(event.code);
  const isLetter = /^[a-z]$/i.test(event.key);
  const name = digit && event.shiftKey ? digit[1] : isLetter ? event.key.toLowerCase() : event.key;
  const hasShift = event.shiftKey && (digit || isLetter || name.length > 1);
  return `${event.ctrlKey || event.metaKey ? 'ctrl+' : ''}${hasShift ? 'shift+' : ''}${name}`;
}

/// actions: functions by nameOfKey. first(event, isDown) may take a key before them by returning true.
export function followKeys(actions, first) {
  addEventListener('keydown', (event) => {
    if (document.querySelector('dialog[open]') || event.isComposing || event.defaultPrevented || isTaken(event)) return;
    if (!event.ctrlKey && !event.metaKey && !event.altKey && first(event, true)) return event.preventDefault();
    const action = event.altKey ? undefined : actions[nameOfKey(event)];
    if (!action) return;
    event.preventDefault();
    action(event);
  });
  addEventListener('keyup', (event) => first(event, false));
  // After a press with the mouse the keys belong to the view again.
  const home = document.getElementById('canvas');
  const giveBack = () => { if (!document.querySelector('dialog[open]')) home.focus({preventScroll: true}); };
  document.addEventListener('click', (event) => { if (event.detail > 0 && event.target.closest('button')) giveBack(); });
  document.addEventListener('change', (event) => { if (event.target.matches('select')) giveBack(); });
  document.addEventListener('pointerup', (event) => { if (event.target.matches('input[type="range"]')) giveBack(); });
}
