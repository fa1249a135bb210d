"use strict";
// The websocket of a page to `thirdhand hands`, in a thread of its own: the page's thread draws, and is late by many
// milliseconds on a busy machine. link.js is the page's side, browser_hands.py and hand_message.py are the server's.
// It receives {connect: address}, {order: name} or hands, and posts {opened}, {closed}, {unsent: name} of an order, the
// server's {text}, and what has changed of {sent, dropped, clock_ms}. Times are in milliseconds since 1970 by this machine's monotonic clock, which the page's
// thread shares.
const PING_MS = 200; // interval of pings
const PRECISE_MS = 2; // until the clock is as precise as this, a ping follows the answer to the last one
const DRIFT = 1e-4; // two clocks drift apart by less than this, 6 ms in a minute
const RESOLUTION_MS = .1; // of a browser's clock
const MAX_BUFFERED_BYTES = 240; // with two messages unsent the socket is behind, and hands are dropped,
const MAX_UNANSWERED = 3; // as with more pings without an answer: what is sent then waits in the network
const SIDES = ["left", "right"];

let socket = null, clock = null, pinged_ms = 0, unanswered = 0, number = 0, sent = 0, dropped = 0;
const message = new DataView(new ArrayBuffer(120));
const now_ms = () => performance.timeOrigin + performance.now();
const isOpen = () => socket?.readyState === WebSocket.OPEN;

function connect(address) {
  socket?.close();
  const opened = socket = new WebSocket(address);
  [clock, unanswered] = [null, 0];
  opened.binaryType = "arraybuffer";
  opened.onopen = () => { postMessage({opened: true}); ping(); };
  opened.onmessage = ({data}) => {
    if (opened !== socket) return;
    if (typeof data === "string") postMessage({text: data});
    else compare(new DataView(data));
  };
  opened.onclose = ({code, reason}) => { if (opened === socket) postMessage({closed: {code, reason}}); };
}
function ping() {
  if (!isOpen()) return;
  const view = new DataView(new ArrayBuffer(16));
  view.setUint32(0, 0x474e4950, true);
  view.setFloat64(8, pinged_ms = now_ms(), true);
  socket.send(view.buffer);
  unanswered++;
}
// The server read its clock between the ping and its answer: in the middle, with an error of at most half of the
// round trip. An answer's error bound grows with its age, because the clocks drift.
const bound_ms = ({trip_ms, at_ms}) => trip_ms / 2 + RESOLUTION_MS + DRIFT * (now_ms() - at_ms);
function compare(pong) {
  const at_ms = now_ms(), sent_ms = pong.getFloat64(8, true);
  const newest = {at_ms, trip_ms: at_ms - sent_ms, offset_ms: pong.getFloat64(16, true) - (sent_ms + at_ms) / 2};
  unanswered = 0;
  // Two answers that contradict each other: a clock was set meanwhile, and the newest answer is right.
  const wasSet = clock && Math.abs(newest.offset_ms - clock.offset_ms) > bound_ms(newest) + bound_ms(clock);
  if (!clock || wasSet || bound_ms(newest) < bound_ms(clock)) clock = newest;
  postMessage({clock_ms: bound_ms(clock)});
  if (sent_ms === pinged_ms && bound_ms(clock) > PRECISE_MS) ping();
}
// Hands by side, {position, orientation, tip, pinch} in metres and x y z w, at a time, predicted for `ahead_ms` later.
// A hand that is missing is not seen.
function send({hands, epoch, time_ms, ahead_ms}) {
  if (!isOpen() || !clock) return;
  const seen = SIDES.reduce((bits, side, i) => bits | (hands[side] ? 1 << i : 0), 0);
  const isBehind = unanswered > MAX_UNANSWERED || socket.bufferedAmount > MAX_BUFFERED_BYTES;
  if (!isBehind) {
    message.setUint32(0, 0x53444e48, true);
    message.setUint8(4, seen);
    message.setUint8(5, epoch);
    message.setUint16(6, number, true);
    message.setFloat64(8, time_ms + clock.offset_ms, true);
    message.setFloat64(16, ahead_ms, true);
    SIDES.forEach((side, i) => {
      const {position = [0, 0, 0], orientation = [0, 0, 0, 1], tip = [0, 0, 0], pinch = 0} = hands[side] ?? {};
      [...position, ...orientation, ...tip, pinch, 0].forEach((value, k) => message.setFloat32(24 + 48 * i + 4 * k, value, true));
    });
    socket.send(message.buffer);
  }
  number = (number + 1) & 0xffff; // also of a message that is dropped, so that the server counts it
  [sent, dropped] = isBehind ? [sent, dropped + 1] : [sent + 1, dropped];
  postMessage({sent, dropped});
}
onmessage = ({data}) => {
  if (data.connect) connect(data.connect);
  else if (data.hands) send(data);
  else if (isOpen()) socket.send(data.order);
  else postMessage({unsent: data.order});
};
setInterval(ping, PING_MS);
