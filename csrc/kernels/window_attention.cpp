// Windowed attention on a polar map.
//
// A window is never cut out of the map: token t of window (wr, wa) is found by index arithmetic
// that includes the shift and the wrap around the border, and its q, k and v are packed into
// scratch that fits L1. Keys are packed transposed, (d, n), so that one query against all keys is a
// sum of d vectors of length n and needs no horizontal operation. Along an axis that is not
// periodic, tokens that the shift brought together across the border carry different `side` marks
// and do not see each other. Forward keeps the log-sum-exp of each row, in double since its
// rounding would enter every probability; backward finds the probabilities from it. Every token
// lies in one window, so qkv gradients have one writer; the bias gradient of an (image, head) is
// summed by one thread over all windows, in order.
#include "kernels.h"
#include "math.h"

namespace darswin::TIER {
namespace {

template <typename T>
struct Shape {
  int64_t n, d;  // tokens of a window, head dim
  int64_t windows_r, windows_a;
  int64_t table_a, table;  // width and size of one head's bias table

  explicit Shape(const WindowAttentionArgs<T>& a)
      : n(a.window_r * a.window_a),
        d(a.head_dim),
        windows_r(a.rings / a.window_r),
        windows_a(a.sectors / a.window_a),
        table_a(2 * a.window_a - 1),
        table((2 * a.window_r - 1) * table_a) {}
};

// Scratch of one thread. Sums over up to 1024 tokens are kept in double.
template <typename T>
struct Scratch {
  double *dk, *dv;  // (n, d): key and value gradients
  double* sum;      // (d,): one query's output, or its gradient
  int64_t* token;   // (n,): places of the window's tokens in (B, R, A)
  T *q, *k, *v;     // (n, d)
  T *kt, *vt;       // (d, n)
  T *row, *drow;    // (n,): one query's logits or probabilities, and their gradient
  T* side;          // (n,): 0 to 3, see find_tokens

  Scratch(double* base, int64_t n, int64_t d) {
    dk = base;
    dv = dk + n * d;
    sum = dv + n * d;
    token = reinterpret_cast<int64_t*>(sum + d);
    q = reinterpret_cast<T*>(token + n);
    k = q + n * d;
    v = k + n * d;
    kt = v + n * d;
    vt = kt + n * d;
    row = vt + n * d;
    drow = row + n;
    side = drow + n;
  }

  static int64_t doubles(int64_t n, int64_t d) {
    const int64_t rest = 5 * n * d + 3 * n;
    return 2 * n * d + d + n + (rest * static_cast<int64_t>(sizeof(T)) + 7) / 8;
  }
};

// Finds the tokens of window (wr, wa) of image b: their places in the map, and their sides of the
// borders, 1 beyond that of the radius and 2 beyond that of the azimuth where these do not wrap.
template <typename T>
void find_tokens(const WindowAttentionArgs<T>& a, int64_t b, int64_t wr, int64_t wa,
                 const Scratch<T>& s) {
  int64_t t = 0;
  for (int64_t tr = 0; tr < a.window_r; ++tr) {
    int64_t r = wr * a.window_r + tr + a.shift_r;
    const bool over_r = r >= a.rings;
    if (over_r) r -= a.rings;
    for (int64_t ta = 0; ta < a.window_a; ++ta, ++t) {
      int64_t sector = wa * a.window_a + ta + a.shift_a;
      const bool over_a = sector >= a.sectors;
      if (over_a) sector -= a.sectors;
      s.token[t] = (b * a.rings + r) * a.sectors + sector;
      s.side[t] = static_cast<T>((over_r && !a.periodic_r) + 2 * (over_a && !a.periodic_a));
    }
  }
}

// Packs one of q, k, v (part 0, 1, 2) of a window: rows (n, d), and columns (d, n) where wanted.
template <typename T>
void pack(const WindowAttentionArgs<T>& a, const Shape<T>& shape, const int64_t* tokens,
          int64_t head, int part, T* rows, T* columns) {
  for (int64_t t = 0; t < shape.n; ++t) {
    const T* from = a.qkv + ((tokens[t] * 3 + part) * a.heads + head) * shape.d;
    for (int64_t c = 0; c < shape.d; ++c) {
      if (rows != nullptr) rows[t * shape.d + c] = from[c];
      if (columns != nullptr) columns[c * shape.n + t] = from[c];
    }
  }
}

// row[k] = sum_c q[c] * columns[c, k]
template <typename T>
void row_times_columns(const T* q, const T* columns, const Shape<T>& shape, T* row) {
  for (int64_t k = 0; k < shape.n; ++k) row[k] = 0;
  for (int64_t c = 0; c < shape.d; ++c) {
    const T* column = columns + c * shape.n;
#pragma omp simd
    for (int64_t k = 0; k < shape.n; ++k) row[k] += q[c] * column[k];
  }
}

// Index of the bias of query t against key 0 of key ring `kr`; the next key's is one lower.
template <typename T>
int64_t bias_index(const WindowAttentionArgs<T>& a, const Shape<T>& shape, int64_t t, int64_t kr) {
  const int64_t delta_r = t / a.window_a - kr + a.window_r - 1;
  return delta_r * shape.table_a + t % a.window_a + a.window_a - 1;
}

// The logits of query t: scaled products, bias, and minus infinity across a border.
template <typename T>
void logits(const WindowAttentionArgs<T>& a, const Shape<T>& shape, const Scratch<T>& s,
            const T* bias, int64_t t) {
  row_times_columns(s.q + t * shape.d, s.kt, shape, s.row);
  for (int64_t kr = 0; kr < a.window_r; ++kr) {
    const T* biases = bias + bias_index(a, shape, t, kr);
    T* row = s.row + kr * a.window_a;
#pragma omp simd
    for (int64_t ka = 0; ka < a.window_a; ++ka) row[ka] = row[ka] * a.scale + biases[-ka];
  }
  const T minus_infinity = static_cast<T>(-__builtin_inf());
  const T side = s.side[t];
  for (int64_t k = 0; k < shape.n; ++k) s.row[k] = s.side[k] == side ? s.row[k] : minus_infinity;
}

template <typename T>
void attend(const WindowAttentionArgs<T>& a, int64_t begin, int64_t end, double* scratch) {
  const Shape<T> shape(a);
  const Scratch<T> s(scratch, shape.n, shape.d);
  for (int64_t item = begin; item < end; ++item) {
    const int64_t head = item % a.heads, window = item / a.heads;
    const int64_t wa = window % shape.windows_a, wr = window / shape.windows_a % shape.windows_r;
    const int64_t b = window / (shape.windows_a * shape.windows_r);
    const T* bias = a.bias + b * a.bias_stride + head * shape.table;
    find_tokens(a, b, wr, wa, s);
    pack(a, shape, s.token, head, 0, s.q, static_cast<T*>(nullptr));
    pack(a, shape, s.token, head, 1, static_cast<T*>(nullptr), s.kt);
    pack(a, shape, s.token, head, 2, s.v, static_cast<T*>(nullptr));
    for (int64_t t = 0; t < shape.n; ++t) {
      logits(a, shape, s, bias, t);
      T largest = s.row[0];
      for (int64_t k = 1; k < shape.n; ++k) largest = s.row[k] > largest ? s.row[k] : largest;
      double sum = 0;
      for (int64_t k = 0; k < shape.n; ++k) {
        s.row[k] = exponential(s.row[k] - largest);
        sum += s.row[k];
      }
      const int64_t token = s.token[t];
      T* out = a.out + (token * a.heads + head) * shape.d;
      for (int64_t c = 0; c < shape.d; ++c) s.sum[c] = 0;
      for (int64_t k = 0; k < shape.n; ++k) {
        const T* value = s.v + k * shape.d;
        const double weight = s.row[k];
#pragma omp simd
        for (int64_t c = 0; c < shape.d; ++c) s.sum[c] += weight * value[c];
      }
      for (int64_t c = 0; c < shape.d; ++c) out[c] = static_cast<T>(s.sum[c] / sum);
      a.lse[token * a.heads + head] = static_cast<double>(largest) + logarithm(sum);
    }
  }
}

template <typename T>
void attend_backward(const WindowAttentionArgs<T>& a, int64_t begin, int64_t end, double* scratch) {
  const Shape<T> shape(a);
  const Scratch<T> s(scratch, shape.n, shape.d);
  const int64_t windows = shape.windows_r * shape.windows_a;
  for (int64_t item = begin; item < end; ++item) {
    const int64_t head = item % a.heads, b = item / a.heads;
    const T* bias = a.bias + b * a.bias_stride + head * shape.table;
    double* grad_bias = a.grad_bias + item * shape.table;
    for (int64_t window = 0; window < windows; ++window) {
      const int64_t wr = window / shape.windows_a, wa = window % shape.windows_a;
      find_tokens(a, b, wr, wa, s);
      pack(a, shape, s.token, head, 0, s.q, static_cast<T*>(nullptr));
      pack(a, shape, s.token, head, 1, s.k, s.kt);
      pack(a, shape, s.token, head, 2, static_cast<T*>(nullptr), s.vt);
      for (int64_t e = 0; e < shape.n * shape.d; ++e) s.dk[e] = s.dv[e] = 0;
      for (int64_t t = 0; t < shape.n; ++t) {
        const int64_t token = s.token[t];
        const T* grad = a.grad_out + (token * a.heads + head) * shape.d;
        const double lse = a.lse[token * a.heads + head];
        // Probabilities p, their gradient dp = grad . v, and ds = p (dp - sum p dp).
        logits(a, shape, s, bias, t);
        row_times_columns(grad, s.vt, shape, s.drow);
        double expected = 0;
        for (int64_t k = 0; k < shape.n; ++k) {
          s.row[k] = exponential(static_cast<T>(s.row[k] - lse));
          expected += static_cast<double>(s.row[k]) * s.drow[k];
        }
        const T mean = static_cast<T>(expected);
        for (int64_t k = 0; k < shape.n; ++k) s.drow[k] = s.row[k] * (s.drow[k] - mean);
        for (int64_t kr = 0; kr < a.window_r; ++kr) {
          double* grads = grad_bias + bias_index(a, shape, t, kr);
          for (int64_t ka = 0; ka < a.window_a; ++ka) grads[-ka] += s.drow[kr * a.window_a + ka];
        }
        const T* query = s.q + t * shape.d;
        for (int64_t c = 0; c < shape.d; ++c) s.sum[c] = 0;
        for (int64_t k = 0; k < shape.n; ++k) {
          const double p = s.row[k], ds = s.drow[k] * a.scale;
          const T* key = s.k + k * shape.d;
          double *dk = s.dk + k * shape.d, *dv = s.dv + k * shape.d;
#pragma omp simd
          for (int64_t c = 0; c < shape.d; ++c) {
            s.sum[c] += ds * key[c];
            dk[c] += ds * query[c];
            dv[c] += p * grad[c];
          }
        }
        T* to = a.grad_qkv + (token * 3 * a.heads + head) * shape.d;
        for (int64_t c = 0; c < shape.d; ++c) to[c] = static_cast<T>(s.sum[c]);
      }
      for (int64_t t = 0; t < shape.n; ++t) {
        const int64_t token = s.token[t];
        T* dk = a.grad_qkv + ((token * 3 + 1) * a.heads + head) * shape.d;
        T* dv = dk + a.heads * shape.d;
        for (int64_t c = 0; c < shape.d; ++c) {
          dk[c] = static_cast<T>(s.dk[t * shape.d + c]);
          dv[c] = static_cast<T>(s.dv[t * shape.d + c]);
        }
      }
    }
  }
}

}  // namespace

int64_t window_attention_scratch(const WindowAttentionArgs<float>& args) {
  return Scratch<float>::doubles(args.window_r * args.window_a, args.head_dim);
}
int64_t window_attention_scratch(const WindowAttentionArgs<double>& args) {
  return Scratch<double>::doubles(args.window_r * args.window_a, args.head_dim);
}
void window_attention(const WindowAttentionArgs<float>& args, int64_t begin, int64_t end,
                      double* scratch) {
  attend(args, begin, end, scratch);
}
void window_attention(const WindowAttentionArgs<double>& args, int64_t begin, int64_t end,
                      double* scratch) {
  attend(args, begin, end, scratch);
}
void window_attention_backward(const WindowAttentionArgs<float>& args, int64_t begin, int64_t end,
                               double* scratch) {
  attend_backward(args, begin, end, scratch);
}
void window_attention_backward(const WindowAttentionArgs<double>& args, int64_t begin, int64_t end,
                               double* scratch) {
  attend_backward(args, begin, end, scratch);
}

}  // namespace darswin::TIER
