/** Values as msgpack, as far as messages to the gateway need it. */

/** Bytes of null, booleans, numbers, BigInts from 0, strings, Uint8Array, arrays and plain objects. */
export function pack(value) {
  const parts = [];
  write(value, parts);
  return new Blob(parts);
}

function write(value, parts) {
  if (value === null) parts.push(bytes(0xc0));
  else if (typeof value === "boolean") parts.push(bytes(value ? 0xc3 : 0xc2));
  else if (typeof value === "number") writeNumber(value, parts);
  else if (typeof value === "bigint") parts.push(wide(value));
  else if (typeof value === "string") writeString(value, parts);
  else if (value instanceof Uint8Array) parts.push(sized(0xc6, value.length), value);
  else if (Array.isArray(value)) {
    parts.push(sized(0xdd, value.length));
    for (const item of value) write(item, parts);
  } else {
    const entries = Object.entries(value);
    parts.push(sized(0xdf, entries.length));
    for (const [key, item] of entries) {
      writeString(key, parts);
      write(item, parts);
    }
  }
}

/** Whole numbers go as integers where 32 bits hold them, all others as float64. */
function writeNumber(value, parts) {
  if (Number.isInteger(value) && value >= 0 && value < 2 ** 32) {
    parts.push(sized(0xce, value));
    return;
  }
  const view = new DataView(new ArrayBuffer(9));
  view.setUint8(0, 0xcb);
  view.setFloat64(1, value);
  parts.push(new Uint8Array(view.buffer));
}

function writeString(text, parts) {
  const content = new TextEncoder().encode(text);
  parts.push(sized(0xdb, content.length), content);
}

const bytes = (...values) => new Uint8Array(values);

/** A code and a 32 bit number, the highest byte first. */
function sized(code, number) {
  const view = new DataView(new ArrayBuffer(5));
  view.setUint8(0, code);
  view.setUint32(1, number);
  return new Uint8Array(view.buffer);
}

/** An unsigned number of 64 bit. */
function wide(value) {
  const view = new DataView(new ArrayBuffer(9));
  view.setUint8(0, 0xcf);
  view.setBigUint64(1, value);
  return new Uint8Array(view.buffer);
}
