// Windowed attention on a polar map.
//
// A window is never cut out of the map: token t of a window is found by index arithmetic that
// includes the shift and the wrap around the border, and the tiles of window_attention_tiles.h read
// its rows where they are. One window is attended to by one head at a time; with 16 tokens all that
// this needs stays in registers and the first cache. Logits stand as (key, query), queries in the
// SIMD lanes. Along an axis that is not periodic, tokens that the shift brought together across the
// border carry different `side` marks and do not see each other. Backward finds the probabilities
// again, just as forward did, so forward saves nothing. Every token lies in one window, so qkv
// gradients have one writer; bias gradients are summed over a chunk of windows, in order.
#include "kernels.h"
#include "math.h"
#include "window_attention_tiles.h"

namespace darswin::TIER {
namespace {

// Up to this many tokens a window, tables of all pairs of tokens are kept for each head.
constexpr int64_t kPairTokens = 64;

// The sizes of one call. A window of one sector counts as one of one ring: the same tokens in the
// same order, but in one long run.
template <typename S>
struct Shape {
  int64_t n, padded;  // tokens of a window; rounded up to whole groups
  int64_t d, heads;
  int64_t windows_r, windows_a, map_windows;  // windows along the axes, and of one image
  int64_t runs, run;       // a window is `runs` times `run` tokens that follow each other
  int64_t table_a, table;  // width and size of one head's bias table
  bool pairs;              // whether there are tables of all pairs

  explicit Shape(const WindowAttentionArgs<S>& a)
      : n(a.window_r * a.window_a),
        padded((n + kGroup - 1) / kGroup * kGroup),
        d(a.head_dim),
        heads(a.heads),
        windows_r(a.rings / a.window_r),
        windows_a(a.sectors / a.window_a),
        map_windows(windows_r * windows_a),
        runs(a.window_a == 1 ? 1 : a.window_r),
        run(n / runs),
        table_a(2 * run - 1),
        table((2 * runs - 1) * table_a),
        pairs(n <= kPairTokens) {}

  // body(key, query, count, index) for all keys and the queries of [begin, end), in runs of queries
  // whose biases follow each other too: that of the first one stands at `index` of the table.
  template <typename Body>
  void for_pairs(int64_t begin, int64_t end, Body body) const {
    const int64_t first_run = begin / run;
    for (int64_t k_run = 0, key = 0; k_run < runs; ++k_run) {
      for (int64_t k = 0; k < run; ++k, ++key) {
        int64_t query = begin, place = begin - first_run * run;
        int64_t row = (first_run - k_run + runs - 1) * table_a + run - 1 - k;
        for (; query < end; row += table_a, place = 0) {
          const int64_t count = run - place < end - query ? run - place : end - query;
          body(key, query, count, row + place);
          query += count;
        }
      }
    }
  }
};

inline int64_t eights(int64_t n) { return (n + 7) / 8 * 8; }

// Hands out pieces of a block of memory, and counts them.
struct Arena {
  char* memory;
  int64_t used = 0;

  template <typename T>
  T* take(int64_t count) {
    T* piece = reinterpret_cast<T*>(memory + used);
    used += (count * static_cast<int64_t>(sizeof(T)) + 63) / 64 * 64;
    return piece;
  }
};

// The tokens of one window.
template <typename T>
struct Tokens {
  int64_t *in, *out;  // (padded,): offsets of a token's row in qkv and in the output
  T* side;            // (padded,): its side of the borders, see find_tokens
  bool parted;        // whether they are on different sides
  int64_t index = -1;

  void take(Arena& arena, int64_t padded) {
    in = arena.take<int64_t>(padded);
    out = arena.take<int64_t>(padded);
    side = arena.take<T>(padded);
  }
};

// Working memory of one thread; (padded,) and so on are the shapes.
template <typename S>
struct Scratch {
  using T = Arithmetic<S>;
  static constexpr bool kCopies = sizeof(S) != sizeof(T);  // rows are widened, and narrowed again

  Tokens<T> window, next;  // the one at work, and the one after it
  int64_t* copy;           // (padded,): offsets of a token's row in a copy
  T* columns;              // (d, group): queries or gradients of a group, transposed
  T *largest, *inverse;    // (group,): of each query, the largest logit; 1 / sum of exponentials
  T *p, *dp;               // (padded, group): logits, then probabilities, and their gradient
  T* bias;                 // (heads, n, padded): all pairs; else (n, group): those of a group
  T* grad_bias;            // (heads, n, padded): summed over a chunk; else unused
  int64_t* bias_row;       // (heads,): the row of the bias that `bias` holds
  T *q, *k, *v, *g;        // (padded, d): copies of rows
  T *dq, *dk, *dv;         // the same of results

  Scratch(Arena& arena, const Shape<S>& shape) {
    const int64_t padded = shape.padded, copies = kCopies ? padded * shape.d : 0;
    const int64_t pairs = shape.pairs ? shape.heads * shape.n * padded : 0;
    window.take(arena, padded);
    next.take(arena, padded);
    copy = arena.take<int64_t>(padded);
    columns = arena.take<T>(shape.d * kGroup);
    p = arena.take<T>(padded * kGroup);
    largest = arena.take<T>(kGroup);
    inverse = arena.take<T>(kGroup);
    dp = arena.take<T>(padded * kGroup);
    bias = arena.take<T>(shape.pairs ? pairs : shape.n * kGroup);
    grad_bias = arena.take<T>(pairs);
    bias_row = arena.take<int64_t>(shape.heads);
    q = arena.take<T>(copies);
    k = arena.take<T>(copies);
    v = arena.take<T>(copies);
    g = arena.take<T>(copies);
    dq = arena.take<T>(copies);
    dk = arena.take<T>(copies);
    dv = arena.take<T>(copies);
  }
};

// One thread's work on a call.
template <typename S>
struct Attention {
  using T = Arithmetic<S>;
  using V = Vector<T, kLanes<T>>;
  static constexpr int kVectors = kGroup / kLanes<T>;

  const WindowAttentionArgs<S>& a;
  Shape<S> shape;
  Arena arena;
  Scratch<S> s;

  Attention(const WindowAttentionArgs<S>& args, void* memory)
      : a(args), shape(args), arena{static_cast<char*>(memory)}, s(arena, shape) {
    for (int64_t head = 0; head < shape.heads; ++head) s.bias_row[head] = -1;
    for (int64_t t = 0; t < shape.padded; ++t) s.copy[t] = (t < shape.n ? t : 0) * shape.d;
  }

  // Finds the rows of a window's tokens, and their sides of the borders: 1 beyond that of the
  // radius and 2 beyond that of the azimuth where these do not wrap. Token 0 pads the last group.
  void find_tokens(int64_t window, Tokens<T>& found) const {
    const int64_t wa = window % shape.windows_a, wr = window / shape.windows_a % shape.windows_r;
    const int64_t image = window / shape.map_windows;
    found.index = window;
    const int64_t out_row = shape.heads * shape.d;
    found.parted = false;
    int64_t t = 0;
    for (int64_t tr = 0; tr < a.window_r; ++tr) {
      int64_t r = wr * a.window_r + tr + a.shift_r;
      const bool over_r = r >= a.rings;
      if (over_r) r -= a.rings;
      for (int64_t ta = 0; ta < a.window_a; ++ta, ++t) {
        int64_t sector = wa * a.window_a + ta + a.shift_a;
        const bool over_a = sector >= a.sectors;
        if (over_a) sector -= a.sectors;
        found.out[t] = ((image * a.rings + r) * a.sectors + sector) * out_row;
        found.in[t] = 3 * found.out[t];
        found.side[t] = static_cast<T>((over_r && !a.periodic_r) + 2 * (over_a && !a.periodic_a));
        found.parted |= found.side[t] != found.side[0];
      }
    }
    for (; t < shape.padded; ++t) {
      found.out[t] = found.out[0];
      found.in[t] = found.in[0];
      found.side[t] = found.side[0];
    }
  }

  // Queries of the group that begins with this one.
  int64_t group_size(int64_t group) const {
    return shape.n - group < kGroup ? shape.n - group : kGroup;
  }

  // Makes `window` the one at work. The one after it is found as well, to be fetched meanwhile.
  void enter(int64_t window) {
    if (window != s.next.index) find_tokens(window, s.next);
    const Tokens<T> last = s.window;
    s.window = s.next;
    s.next = last;
    find_tokens(window + 1 < a.windows ? window + 1 : window, s.next);
  }

  // Asks for the same rows of the next window, a group at a time.
  void fetch(const S* map, const int64_t* offset, int64_t group) const {
    const int64_t end = group + group_size(group);
    constexpr int64_t kLine = 64 / sizeof(S);
    for (int64_t t = group; t < end; ++t) {
      const S* row = map + offset[t];
      for (int64_t c = 0; c < shape.d; c += kLine) __builtin_prefetch(row + c);
    }
  }

  // The rows of a window's tokens, of T: those of the map, or a widened copy.
  Rows<const T> read(const S* map, const int64_t* offset, T* copy) const {
    if constexpr (Scratch<S>::kCopies) {
      for (int64_t t = 0; t < shape.n; ++t) widen(map + offset[t], shape.d, copy + t * shape.d);
      return {copy, s.copy};
    } else {
      return {map, offset};
    }
  }
  // Where to write rows; those that stand in a copy are rounded into the map by `finish`.
  Rows<T> write(S* map, const int64_t* offset, T* copy) const {
    if constexpr (Scratch<S>::kCopies) {
      return {copy, s.copy};
    } else {
      return {map, offset};
    }
  }
  void finish(Rows<T> rows, S* map, const int64_t* offset) const {
    if constexpr (Scratch<S>::kCopies) {
      for (int64_t t = 0; t < shape.n; ++t) narrow(rows[t], shape.d, map + offset[t]);
    }
  }

  // Makes the table of the biases of all pairs, where it is not the one of this row already.
  void prepare_bias(int64_t head, int64_t row) {
    if (!shape.pairs || s.bias_row[head] == row) return;
    s.bias_row[head] = row;
    spread_bias(head, row, 0, shape.n, s.bias + head * shape.n * shape.padded, shape.padded);
  }
  // to[key * stride + query - begin] = the bias of (query, key)
  void spread_bias(int64_t head, int64_t row, int64_t begin, int64_t end, T* to, int64_t stride) {
    const T* table = a.bias + (row * shape.heads + head) * shape.table;
    shape.for_pairs(begin, end, [&](int64_t key, int64_t query, int64_t count, int64_t index) {
      T* biases = to + key * stride + query - begin;
      for (int64_t i = 0; i < count; ++i) biases[i] = table[index + i];
    });
  }

  // s.p = e^(logit - the largest logit) of all keys for each query of the group, and s.inverse =
  // 1 / their sums.
  void exponentials(Rows<const T> q, Rows<const T> k, int64_t head, int64_t row, int64_t group) {
    const int64_t n = shape.n;
    const T* biases = s.bias + head * n * shape.padded + group;
    int64_t stride = shape.padded;
    if (!shape.pairs) {
      spread_bias(head, row, group, group + group_size(group), s.bias, kGroup);
      biases = s.bias;
      stride = kGroup;
    }
    const S* map = a.qkv + head * shape.d;
    const int64_t part = shape.heads * shape.d;
    fetch(map, s.next.in, group);
    transpose(q.from(group), shape.d, s.columns);
    fetch(map + part, s.next.in, group);
    if (s.window.parted) {
      logits<true>(k, biases, stride, group);
    } else {
      logits<false>(k, biases, stride, group);
    }
    fetch(map + 2 * part, s.next.in, group);
    for (int lane = 0; lane < kGroup; lane += kLanes<T>) exponentials(lane);
  }

  // s.p = the logits, s.largest = the largest of each query. Keys that pad the last eight have
  // minus infinity, as those across a border do.
  template <bool kParted>
  __attribute__((noinline)) void logits(Rows<const T> k, const T* biases, int64_t stride,
                                        int64_t group) {
    const V scale = splat<V>(a.scale), nothing = splat<V>(static_cast<T>(-__builtin_inf()));
    V largest[kVectors];
    for (int v = 0; v < kVectors; ++v) largest[v] = nothing;
    const T* side = s.window.side;
    products(s.columns, k, eights(shape.n), shape.d, [&](int64_t key, int v, V product) {
      const int lane = v * kLanes<T>;
      V logit = product * scale + load<V>(biases + key * stride + lane);
      if (kParted) logit = splat<V>(side[key]) == load<V>(side + group + lane) ? logit : nothing;
      if (key >= shape.n) logit = nothing;
      largest[v] = larger(logit, largest[v]);
      store(s.p + key * kGroup + lane, logit);
    });
    for (int v = 0; v < kVectors; ++v) store(s.largest + v * kLanes<T>, largest[v]);
  }

  // From logits to exponentials, for the queries of one register.
  __attribute__((noinline)) void exponentials(int lane) {
    T* p = s.p + lane;
    const V largest = load<V>(s.largest + lane);
    V sums[4] = {};
    for (int64_t k = 0; k < shape.n; k += 4) {
#pragma GCC unroll 4
      for (int i = 0; i < 4; ++i) {
        const V e = exponential_of_negative(load<V>(p + (k + i) * kGroup) - largest);
        sums[i] += e;
        store(p + (k + i) * kGroup, e);
      }
    }
    store(s.inverse + lane, 1 / ((sums[0] + sums[1]) + (sums[2] + sums[3])));
  }

  // One head of one window.
  void forward(int64_t head, int64_t row) {
    const int64_t d = shape.d, part = shape.heads * d;
    prepare_bias(head, row);
    const S* map = a.qkv + head * d;
    S* to = a.out + head * d;
    const Rows<const T> q = read(map, s.window.in, s.q);
    const Rows<const T> k = read(map + part, s.window.in, s.k);
    const Rows<const T> v = read(map + 2 * part, s.window.in, s.v);
    const Rows<T> out = write(to, s.window.out, s.dq);
    for (int64_t group = 0; group < shape.n; group += kGroup) {
      exponentials(q, k, head, row, group);
      fetch(to, s.next.out, group);
      weighted_sums(
          Weights<1, kGroup, T>{s.p}, v, shape.n, out.from(group), group_size(group), d,
          [&](int64_t query) { return s.inverse[query]; }, false);
    }
    finish(out, to, s.window.out);
  }

  // One head of one window; grad_bias is its row of bias gradients.
  void backward(int64_t head, int64_t row, double* grad_bias) {
    const int64_t d = shape.d, n = shape.n, part = shape.heads * d;
    prepare_bias(head, row);
    const S* map = a.qkv + head * d;
    S* to = a.grad_qkv + head * d;
    const Rows<const T> q = read(map, s.window.in, s.q);
    const Rows<const T> k = read(map + part, s.window.in, s.k);
    const Rows<const T> v = read(map + 2 * part, s.window.in, s.v);
    const Rows<const T> g = read(a.grad_out + head * d, s.window.out, s.g);
    const Rows<T> dq = write(to, s.window.in, s.dq);
    const Rows<T> dk = write(to + part, s.window.in, s.dk);
    const Rows<T> dv = write(to + 2 * part, s.window.in, s.dv);
    for (int64_t group = 0; group < n; group += kGroup) {
      const int64_t queries = group_size(group);
      exponentials(q, k, head, row, group);
      fetch(a.grad_out + head * d, s.next.out, group);
      transpose(g.from(group), d, s.columns);
      probability_gradients(v);
      softmax_backward(head, group, queries, grad_bias);
      const bool add = group > 0;
      const auto one = [](int64_t) { return T{1}; };
      const auto scale = [&](int64_t) { return a.scale; };
      fetch(to, s.next.in, group);
      weighted_sums(Weights<kGroup, 1, T>{s.p}, g.from(group), queries, dv, n, d, one, add);
      fetch(to + part, s.next.in, group);
      weighted_sums(Weights<kGroup, 1, T>{s.dp}, q.from(group), queries, dk, n, d, scale, add);
      fetch(to + 2 * part, s.next.in, group);
      weighted_sums(Weights<1, kGroup, T>{s.dp}, k, n, dq.from(group), queries, d, scale, false);
    }
    finish(dq, to, s.window.in);
    finish(dk, to + part, s.window.in);
    finish(dv, to + 2 * part, s.window.in);
  }

  // s.dp = the gradients of the probabilities.
  __attribute__((noinline)) void probability_gradients(Rows<const T> v) {
    products(s.columns, v, eights(shape.n), shape.d, [&](int64_t key, int r, V product) {
      store(s.dp + key * kGroup + r * kLanes<T>, product);
    });
  }

  // s.p = the probabilities p, and s.dp, from their gradients to those of the logits, which are
  // the biases' as well: p (dp - sum p dp).
  void softmax_backward(int64_t head, int64_t group, int64_t queries, double* grad_bias) {
    T* pairs = s.grad_bias + head * shape.n * shape.padded + group;
    for (int lane = 0; lane < kGroup; lane += kLanes<T>) {
      if (shape.pairs) {
        softmax_backward<true>(lane, pairs + lane);
      } else {
        softmax_backward<false>(lane, nullptr);
      }
    }
    if (!shape.pairs) fold_pairs(s.dp - group, kGroup, group, group + queries, grad_bias);
  }
  template <bool kPairs>
  __attribute__((noinline)) void softmax_backward(int lane, T* pairs) {
    T *p = s.p + lane, *dp = s.dp + lane;
    const V inverse = load<V>(s.inverse + lane);
    V means[4] = {};
    for (int64_t k = 0; k < shape.n; k += 4) {
#pragma GCC unroll 4
      for (int i = 0; i < 4; ++i) {
        T* probability = p + (k + i) * kGroup;
        store(probability, load<V>(probability) * inverse);
        means[i] += load<V>(probability) * load<V>(dp + (k + i) * kGroup);
      }
    }
    const V mean = (means[0] + means[1]) + (means[2] + means[3]);
    for (int64_t k = 0; k < shape.n; ++k) {
      const V ds = load<V>(p + k * kGroup) * (load<V>(dp + k * kGroup) - mean);
      store(dp + k * kGroup, ds);
      if (kPairs) store(pairs + k * shape.padded, load<V>(pairs + k * shape.padded) + ds);
    }
  }

  // Adds gradients of pairs, [key * stride + query], to a table.
  void fold_pairs(const T* pairs, int64_t stride, int64_t begin, int64_t end, double* table) const {
    shape.for_pairs(begin, end, [&](int64_t key, int64_t query, int64_t count, int64_t index) {
      const T* grads = pairs + key * stride + query;
      for (int64_t i = 0; i < count; ++i) table[index + i] += grads[i];
    });
  }

  int64_t bias_row(int64_t window) const {
    return a.bias_rows == 1 ? 0 : window / shape.map_windows;
  }

  void forward_range(int64_t begin, int64_t end) {
    for (int64_t item = begin; item < end;) {
      const int64_t window = item / shape.heads;
      enter(window);
      for (; item < end && item / shape.heads == window; ++item) {
        forward(item % shape.heads, bias_row(window));
      }
    }
  }

  // Windows outside, heads inside: a token's heads stand side by side.
  void backward_range(int64_t begin, int64_t end) {
    const int64_t row_windows = a.windows / a.bias_rows;
    for (int64_t item = begin; item < end;) {
      const int64_t chunk = item / shape.heads, head_begin = item % shape.heads;
      const int64_t left = shape.heads - head_begin;
      const int64_t heads = end - item < left ? end - item : left;
      double* grad_bias = a.grad_bias + item * shape.table;
      const int64_t row = chunk % a.bias_rows, first = chunk / a.bias_rows * a.chunk;
      const int64_t last = first + a.chunk < row_windows ? first + a.chunk : row_windows;
      T* pairs = s.grad_bias + head_begin * shape.n * shape.padded;
      if (shape.pairs) {
        for (int64_t i = 0; i < heads * shape.n * shape.padded; ++i) pairs[i] = 0;
      }
      for (int64_t window = row * row_windows + first; window < row * row_windows + last;
           ++window) {
        enter(window);
        for (int64_t h = 0; h < heads; ++h) {
          backward(head_begin + h, bias_row(window), grad_bias + h * shape.table);
        }
      }
      if (shape.pairs) {
        for (int64_t h = 0; h < heads; ++h) {
          fold_pairs(pairs + h * shape.n * shape.padded, shape.padded, 0, shape.n,
                     grad_bias + h * shape.table);
        }
      }
      item += heads;
    }
  }
};

template <typename S>
int64_t scratch_bytes(const WindowAttentionArgs<S>& args) {
  Arena arena{nullptr};
  Scratch<S>(arena, Shape<S>(args));
  return arena.used;
}

}  // namespace

int64_t window_attention_scratch(const WindowAttentionArgs<float>& args) {
  return scratch_bytes(args);
}
int64_t window_attention_scratch(const WindowAttentionArgs<double>& args) {
  return scratch_bytes(args);
}
int64_t window_attention_scratch(const WindowAttentionArgs<bfloat16>& args) {
  return scratch_bytes(args);
}
void window_attention(const WindowAttentionArgs<float>& args, int64_t begin, int64_t end,
                      void* scratch) {
  Attention<float>(args, scratch).forward_range(begin, end);
}
void window_attention(const WindowAttentionArgs<double>& args, int64_t begin, int64_t end,
                      void* scratch) {
  Attention<double>(args, scratch).forward_range(begin, end);
}
void window_attention(const WindowAttentionArgs<bfloat16>& args, int64_t begin, int64_t end,
                      void* scratch) {
  Attention<bfloat16>(args, scratch).forward_range(begin, end);
}
void window_attention_backward(const WindowAttentionArgs<float>& args, int64_t begin, int64_t end,
                               void* scratch) {
  Attention<float>(args, scratch).backward_range(begin, end);
}
void window_attention_backward(const WindowAttentionArgs<double>& args, int64_t begin, int64_t end,
                               void* scratch) {
  Attention<double>(args, scratch).backward_range(begin, end);
}
void window_attention_backward(const WindowAttentionArgs<bfloat16>& args, int64_t begin,
                               int64_t end, void* scratch) {
  Attention<bfloat16>(args, scratch).backward_range(begin, end);
}

}  // namespace darswin::TIER
