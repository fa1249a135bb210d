"use strict";
// Drawing with WebGL 2: balls, rods, rings, discs and a board with text. Matrices are column-major, as WebGL takes them.
const Matrix = {
  multiply(a, b) {
    const out = new Float32Array(16);
    for (let c = 0; c < 4; c++)
      for (let r = 0; r < 4; r++)
        for (let k = 0; k < 4; k++) out[4 * c + r] += a[4 * k + r] * b[4 * c + k];
    return out;
  },
  perspective(view_rad, aspect, near = .05, far = 30) {
    const f = 1 / Math.tan(view_rad / 2), d = near - far;
    return [f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / d, -1, 0, 0, 2 * far * near / d, 0];
  },
  columns: (x, y, z, at) => [...x, 0, ...y, 0, ...z, 0, ...at, 1],
  ofPose([x, y, z], [i, j, k, w]) {
    return Matrix.columns([1 - 2 * (j * j + k * k), 2 * (i * j + k * w), 2 * (i * k - j * w)],
      [2 * (i * j - k * w), 1 - 2 * (i * i + k * k), 2 * (j * k + i * w)],
      [2 * (i * k + j * w), 2 * (j * k - i * w), 1 - 2 * (i * i + j * j)], [x, y, z]);
  },
  inverse(m) { // of a rotation and a translation
    const columns = [0, 1, 2].map(r => [m[r], m[4 + r], m[8 + r]]);
    return Matrix.columns(...columns, [0, 1, 2].map(r => -dot([m[4 * r], m[4 * r + 1], m[4 * r + 2]], [m[12], m[13], m[14]])));
  },
  apply: (m, [x, y, z]) => [0, 1, 2].map(r => m[r] * x + m[4 + r] * y + m[8 + r] * z + m[12 + r]),
};
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const subtract = (a, b) => a.map((value, i) => value - b[i]);
const scale = (a, factor) => a.map(value => value * factor);
const add = (a, b) => a.map((value, i) => value + b[i]);
const norm = a => Math.hypot(...a);
const normalize = a => scale(a, 1 / (norm(a) || 1));
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

class Painter {
  constructor(gl) {
    this.gl = gl;
    const program = this.program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, Painter.VERTEX], [gl.FRAGMENT_SHADER, Painter.FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    this.uniforms = Object.fromEntries(["view", "model", "colour", "light", "isBoard"].map(name => [name, gl.getUniformLocation(program, name)]));
    const around = count => Array.from({length: count + 1}, (_, i) => 2 * Math.PI * i / count);
    // Points of each shape with their normals: a strip between neighbouring rows of a surface.
    this.ball = this.shape(around(8).map(a => a / 2), around(12), (a, b) => {
      const n = [Math.sin(a) * Math.cos(b), Math.cos(a), Math.sin(a) * Math.sin(b)];
      return [n, n];
    });
    this.rod = this.shape([0, 1], around(8), (y, b) => [[Math.cos(b), y, Math.sin(b)], [Math.cos(b), 0, Math.sin(b)]]);
    this.ring = this.shape(around(32), around(6), (a, b) => {
      const out = [Math.cos(a), 0, Math.sin(a)], n = add(scale(out, Math.cos(b)), [0, Math.sin(b), 0]);
      return [add(out, scale(n, .06)), n];
    });
    this.disc = this.shape([0, 1], around(32), (r, b) => [[r * Math.cos(b), 0, r * Math.sin(b)], [0, 1, 0]]);
    this.square = this.shape([-1, 1], [-1, 1], (y, x) => [[x, y, 0], [(x + 1) / 2, (1 - y) / 2, 0]]);
    this.texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
    for (const along of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, along, gl.CLAMP_TO_EDGE);
  }
  shape(rows, columns, point) {
    const gl = this.gl, data = [], array = gl.createVertexArray();
    for (let i = 0; i + 1 < rows.length; i++)
      for (let j = 0; j + 1 < columns.length; j++)
        for (const [r, c] of [[i, j], [i + 1, j], [i, j + 1], [i, j + 1], [i + 1, j], [i + 1, j + 1]])
          data.push(...point(rows[r], columns[c]).flat());
    gl.bindVertexArray(array);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(data), gl.STATIC_DRAW);
    for (const k of [0, 1]) {
      gl.enableVertexAttribArray(k);
      gl.vertexAttribPointer(k, 3, gl.FLOAT, false, 24, 12 * k);
    }
    return {array, count: data.length / 6};
  }
  // Begin a picture from a view; `light` is the direction to the light in the view's world.
  begin(view, light) {
    const gl = this.gl;
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.useProgram(this.program);
    gl.uniformMatrix4fv(this.uniforms.view, false, view);
    gl.uniform3fv(this.uniforms.light, normalize(light));
  }
  draw(shape, model, colour, alpha = 1, isBoard = false) {
    const gl = this.gl;
    gl.uniformMatrix4fv(this.uniforms.model, false, model);
    gl.uniform4f(this.uniforms.colour, ...colour.map(value => value / 255), alpha);
    gl.uniform1i(this.uniforms.isBoard, isBoard);
    gl.bindVertexArray(shape.array);
    gl.drawArrays(gl.TRIANGLES, 0, shape.count);
  }
  drawBall(at, radius, colour, alpha) {
    this.draw(this.ball, Matrix.columns([radius, 0, 0], [0, radius, 0], [0, 0, radius], at), colour, alpha);
  }
  drawRod(from, to, radius, colour, alpha) {
    const along = subtract(to, from), side = normalize(cross(along, Math.abs(normalize(along)[1]) < .9 ? [0, 1, 0] : [1, 0, 0]));
    const x = scale(side, radius), z = scale(normalize(cross(side, along)), radius);
    this.draw(this.rod, Matrix.columns(x, along, z, from), colour, alpha);
  }
  drawFlat(shape, at, radius, up, colour, alpha) {
    const x = normalize(cross(up, Math.abs(up[0]) < .9 ? [1, 0, 0] : [0, 1, 0])), z = cross(x, up);
    this.draw(shape, Matrix.columns(scale(x, radius), scale(up, radius), scale(z, radius), at), colour, alpha);
  }
  // A board with the picture of a canvas: its centre, the eye that it faces, up, and its height.
  drawBoard(picture, at, eye, up, height) {
    const gl = this.gl, z = normalize(subtract(eye, at)), x = normalize(cross(up, z)), y = cross(z, x);
    if (this.uploaded !== picture.version) {
      this.uploaded = picture.version;
      gl.bindTexture(gl.TEXTURE_2D, this.texture);
      gl.pixelStorei(gl.UNPACK_PREMULTIPLY_ALPHA_WEBGL, true);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, picture.canvas);
      gl.generateMipmap(gl.TEXTURE_2D);
    }
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    const width = height * picture.canvas.width / picture.canvas.height;
    this.draw(this.square, Matrix.columns(scale(x, width / 2), scale(y, height / 2), z, at), [255, 255, 255], 1, true);
  }
  static VERTEX = `#version 300 es
    layout(location = 0) in vec3 point; layout(location = 1) in vec3 normal;
    uniform mat4 view, model; out vec3 facing;
    uniform bool isBoard;
    void main() {
      gl_Position = view * model * vec4(point, 1);
      facing = isBoard ? normal : normalize(mat3(model) * normal);
    }`;
  static FRAGMENT = `#version 300 es
    precision mediump float;
    in vec3 facing; uniform vec4 colour; uniform vec3 light; uniform bool isBoard; uniform sampler2D picture;
    out vec4 shown;
    void main() {
      if (isBoard) { shown = texture(picture, facing.xy); return; }
      float bright = .55 + .45 * (.5 + .5 * dot(normalize(facing), light));
      shown = vec4(colour.rgb * bright * colour.a, colour.a);
    }`;
}
