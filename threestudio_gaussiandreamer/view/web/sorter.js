// The worker that sorts Gaussians by depth. It is started from this function's own source.

function sorter() {
  const DIGITS = 65536;
  let means = null, depths, bits, order, spare;

  // Depths of the Gaussians between near and far, and their numbers; returns how many there are.
  function measure([a, b, c], offset, near, far) {
    const [x, y, z] = means;
    let visible = 0;
    for (let i = 0; i < x.length; i++) {
      const depth = a * x[i] + b * y[i] + c * z[i] + offset;
      depths[i] = depth;
      if (depth > near && depth < far) order[visible++] = i;
    }
    return visible;
  }

  // One pass of a radix sort by 16 bits; `reversed` places the largest first.
  function pass(from, to, count, shift, reversed) {
    const starts = new Uint32Array(DIGITS);
    for (let i = 0; i < count; i++) starts[(bits[from[i]] >>> shift) & 65535]++;
    for (let digit = 0, sum = 0; digit < DIGITS; digit++) {
      const size = starts[digit];
      starts[digit] = sum;
      sum += size;
    }
    for (let i = 0; i < count; i++) {
      const place = starts[(bits[from[i]] >>> shift) & 65535]++;
      to[reversed ? count - 1 - place : place] = from[i];
    }
  }

  onmessage = ({ data }) => {
    if (data.means) {
      means = data.means;
      const count = means[0].length;
      depths = new Float32Array(count);
      bits = new Uint32Array(depths.buffer);  // of positive floats, in the order of the floats
      order = new Uint32Array(count);
      spare = new Uint32Array(count);
      return;
    }
    const visible = measure(data.row, data.offset, data.near, data.far);
    const sorted = data.buffer;
    pass(order, spare, visible, 0, false);
    pass(spare, sorted, visible, 16, true);
    postMessage({ sorted, visible, request: data.request }, [sorted.buffer]);
  };
}

const ORDER_WIDTH = 2048;  // of the texture that takes the sorted numbers, in whole rows

// Sorts the Gaussians of one cloud back to front, ties by number, one request at a time.
class DepthOrder {
  constructor(columns, toSorted) {
    const source = new Blob([`(${sorter})()`], { type: "text/javascript" });
    this.worker = new Worker(URL.createObjectURL(source));
    this.worker.postMessage({ means: columns.slice(0, 3) });
    this.buffer = new Uint32Array(Math.ceil(columns[0].length / ORDER_WIDTH) * ORDER_WIDTH);
    this.toSorted = toSorted;
    this.waiting = null;  // the newest camera that came while the worker was busy
    this.requested = this.finished = 0;
    this.worker.onmessage = ({ data }) => this.receive(data);
  }

  sort(camera, near, far) {
    this.waiting = { row: camera.rotation[2], offset: camera.translation[2], near, far };
    this.requested++;
    if (this.buffer) this.send();
  }

  send() {
    const message = { ...this.waiting, buffer: this.buffer, request: this.requested };
    this.worker.postMessage(message, [this.buffer.buffer]);
    this.waiting = this.buffer = null;
  }

  receive({ sorted, visible, request }) {
    this.toSorted(sorted, visible);
    this.buffer = sorted;
    this.finished = request;
    if (this.waiting) this.send();
  }

  // Whether the order is that of the camera that was given last.
  get settled() {
    return this.finished === this.requested;
  }
}
