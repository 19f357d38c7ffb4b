// Windowed attention on a polar map.
//
// The kernel never copies a window out of the map. Index arithmetic finds the rows of the window's
// tokens, including the shift and the wrap around the border. The functions in
// window_attention_tiles.h read these rows in place. One head attends to one window at a time. With
// 16 tokens, all numbers of this step stay in registers and in the first-level cache. Logits are
// stored as (key, query), with the queries in the SIMD lanes.
//
// Along an axis that is not periodic, the shift can put tokens from opposite borders into one
// window. Such tokens have different `side` marks and do not attend to each other.
//
// Backward computes the probabilities again, exactly as forward did, so forward saves nothing.
// Every token lies in one window, so each gradient of qkv is written by one thread. The gradients
// of the bias are summed over a chunk of windows, in a fixed order.
#include "../window_attention.h"

#include "math.h"
#include "quantize.h"
#include "window_attention_scratch.h"
#include "window_attention_tiles.h"

namespace darswin {
namespace {

// The state of one thread during one call.
template <typename S, int64_t kTokens, int64_t kDim>
struct Attention {
  using T = Arithmetic<S>;
  using V = Vector<T, kLanes<T>>;
  static constexpr int kVectors = kGroup / kLanes<T>;

  const WindowAttentionArgs<S>& a;
  Shape<kTokens, kDim> shape;
  Arena arena;
  AttentionScratch<S> s;
  int64_t part;            // distance from queries to keys, and from keys to values
  int64_t bias_row, head;  // the current ones
  Rows<const T> q, k, v;   // of the current head

  Attention(const WindowAttentionArgs<S>& args, void* memory)
      : a(args),
        shape(args),
        arena{static_cast<char*>(memory)},
        s(arena, shape),
        part(shape.heads * shape.d) {
    for (int64_t head = 0; head < shape.heads; ++head) s.bias_row[head] = -1;
    for (int64_t t = 0; t < shape.padded; ++t) s.copy[t] = (t < shape.n ? t : 0) * shape.d;
  }

  // True if backward stores the gradients past the caches: the caches cannot hold the map, and each
  // number is stored once, in a whole register.
  bool streams() const {
    const auto address = reinterpret_cast<uintptr_t>(a.grad_qkv);
    return sizeof(S) == sizeof(T) && shape.far && shape.n <= kGroup && shape.d % kLanes<T> == 0 &&
           address % kRegister == 0;
  }

  // Returns the number of queries in the group that begins at query `group`.
  int64_t group_size(int64_t group) const { return smaller(shape.n - group, kGroup); }

  // Makes `window` the current window. Also finds the next window, whose rows are prefetched while
  // this one is computed.
  void enter(int64_t window) {
    s.next.find(a, shape, window);
    const Tokens<T> last = s.window;
    s.window = s.next;
    s.next = last;
    s.next.find(a, shape, window + 1 < a.windows ? window + 1 : window);
    bias_row = a.bias_rows == 1 ? 0 : window / shape.map_windows;
  }

  // Prefetches the same rows of the next window, one group at a time, two cache lines a step. The
  // function must be inlined: the compiler would drop calls to a function that only prefetches,
  // because it seems to have no effect.
  __attribute__((always_inline)) void fetch(const S* map, const int64_t* offset,
                                            int64_t group) const {
    if (!shape.far) return;
    // The loop is not unrolled: thirty-two prefetches in a row took much longer than none at all.
    const int64_t end = group + group_size(group), row = shape.d * static_cast<int64_t>(sizeof(S));
#pragma GCC unroll 1
    for (int64_t t = group; t < end; ++t) {
      const char* lines = reinterpret_cast<const char*>(map + offset[t]);
      for (int64_t c = 0; c < row; c += 128) {
        __builtin_prefetch(lines + c);
        __builtin_prefetch(lines + c + 64);
      }
    }
  }

  // Returns the place to read a window's rows of type T: the map, or a widened copy.
  Rows<const T> read(const S* map, const int64_t* offset, T* copy) const {
    if constexpr (sizeof(S) == sizeof(T)) {
      return {map, offset};
    } else {
      for (int64_t t = 0; t < shape.n; ++t) widen(map + offset[t], shape.d, copy + s.copy[t]);
      return {copy, s.copy};
    }
  }
  // Returns the place to write the rows. `finish` rounds the rows of a copy into the map.
  Rows<T> write(S* map, const int64_t* offset, T* copy) const {
    if constexpr (sizeof(S) == sizeof(T)) {
      return {map, offset};
    } else {
      return {copy, s.copy};
    }
  }
  void finish(S* map, const int64_t* offset, const T* copy) const {
    if constexpr (sizeof(S) != sizeof(T)) {
      for (int64_t t = 0; t < shape.n; ++t) narrow(copy + s.copy[t], shape.d, map + offset[t]);
    }
  }

  const S* queries() const { return a.qkv + head * shape.d; }
  T* pairs(T* tables) const { return tables + head * shape.n * shape.padded; }

  void begin(int64_t index) {
    head = index;
    q = read(queries(), s.window.in, s.q_copy);
    k = read(queries() + part, s.window.in, s.k_copy);
    v = read(queries() + 2 * part, s.window.in, s.v_copy);
    if (shape.pairs && s.bias_row[head] != bias_row) {
      s.bias_row[head] = bias_row;
      spread_bias(0, shape.n, pairs(s.pair_bias), shape.padded);
    }
  }

  // Writes to[key * stride + query - begin] = the bias of (query, key).
  void spread_bias(int64_t begin, int64_t end, T* to, int64_t stride) const {
    const T* table = a.bias + (bias_row * shape.heads + head) * shape.table;
    shape.for_pairs(begin, end, [&](int64_t key, int64_t query, int64_t count, int64_t index) {
      T* biases = to + key * stride + query - begin;
      for (int64_t i = 0; i < count; ++i) biases[i] = table[index + i];
    });
  }

  void logits(int64_t group) const {
    const T* biases = pairs(s.pair_bias) + group;
    int64_t stride = shape.padded;
    if (!shape.pairs) {
      spread_bias(group, group + group_size(group), s.group_bias, kGroup);
      biases = s.group_bias;
      stride = kGroup;
    }
    s.window.parted ? logits<true>(biases, stride, group) : logits<false>(biases, stride, group);
  }

  // Writes the logits to s.p and the largest logit of each query to s.largest. Keys that pad the
  // last eight get minus infinity, and so do keys across a border.
  template <bool kParted>
  __attribute__((noinline)) void logits(const T* biases, int64_t stride, int64_t group) const {
    const V scale = splat<V>(a.scale), nothing = splat<V>(static_cast<T>(-__builtin_inf()));
    V largest[kVectors];
    for (int v = 0; v < kVectors; ++v) largest[v] = nothing;
    T* p = s.p;
    const T* side = s.window.side;
    products(s.columns, k, shape.eights, shape.d, [&](int64_t key, int v, V product) {
      const int lane = v * kLanes<T>;
      V logit = product * scale + load<V>(biases + key * stride + lane);
      if (kParted) logit = splat<V>(side[key]) == load<V>(side + group + lane) ? logit : nothing;
      if (key >= shape.n) logit = nothing;
      largest[v] = larger(logit, largest[v]);
      store(p + key * kGroup + lane, logit);
    });
    for (int v = 0; v < kVectors; ++v) store(s.largest + v * kLanes<T>, largest[v]);
  }

  // Replaces s.p by e^(logit - largest logit), and writes 1 / their sum to s.inverse.
  __attribute__((noinline)) void exponentials() const {
    for (int lane = 0; lane < kGroup; lane += kLanes<T>) {
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
  }

  // Writes the gradients of the probabilities to s.dp.
  __attribute__((noinline)) void probability_gradients() const {
    T* dp = s.dp;
    products(s.columns, v, shape.eights, shape.d, [&](int64_t key, int v, V product) {
      store(dp + key * kGroup + v * kLanes<T>, product);
    });
  }

  // Replaces s.p by the probabilities p, and s.dp by the gradients of the logits, p (dp - sum p
  // dp). These are the gradients of the biases too.
  void softmax_backward(int64_t group, double* grad_bias) const {
    if (shape.pairs) {
      softmax_backward<true>(group);
    } else {
      softmax_backward<false>(group);
      fold_pairs(s.dp - group, kGroup, group, group + group_size(group), grad_bias);
    }
  }
  template <bool kPairs>
  __attribute__((noinline)) void softmax_backward(int64_t group) const {
    for (int lane = 0; lane < kGroup; lane += kLanes<T>) {
      T *p = s.p + lane, *dp = s.dp + lane;
      T* sums = pairs(s.pair_grad) + group + lane;
      const V inverse = load<V>(s.inverse + lane);
      V means[4] = {};
      for (int64_t k = 0; k < shape.n; k += 4) {
#pragma GCC unroll 4
        for (int i = 0; i < 4; ++i) {
          const V probability = load<V>(p + (k + i) * kGroup) * inverse;
          store(p + (k + i) * kGroup, probability);
          means[i] += probability * load<V>(dp + (k + i) * kGroup);
        }
      }
      const V mean = (means[0] + means[1]) + (means[2] + means[3]);
      for (int64_t k = 0; k < shape.n; ++k) {
        const V ds = load<V>(p + k * kGroup) * (load<V>(dp + k * kGroup) - mean);
        store(dp + k * kGroup, ds);
        if (kPairs) store(sums + k * shape.padded, load<V>(sums + k * shape.padded) + ds);
      }
    }
  }

  // Adds the gradients of pairs, pair_grad[key * stride + query], to a bias table.
  void fold_pairs(const T* pair_grad, int64_t stride, int64_t begin, int64_t end,
                  double* table) const {
    shape.for_pairs(begin, end, [&](int64_t key, int64_t query, int64_t count, int64_t index) {
      const T* grads = pair_grad + key * stride + query;
      for (int64_t i = 0; i < count; ++i) table[index + i] += grads[i];
    });
  }

  // Takes the steps from queries and keys to the exponentials, for the queries of one group.
  // Between the steps, it prefetches a few rows of the next window.
  void weights(int64_t group) const {
    fetch(queries(), s.next.in, group);
    transpose(q.from(group), shape.d, s.columns);
    fetch(queries() + part, s.next.in, group);
    logits(group);
    fetch(queries() + 2 * part, s.next.in, group);
    exponentials();
  }

  // Computes one head of the current window. Results of 8 bits are computed as floats in a copy
  // first.
  void forward(int64_t index) {
    begin(index);
    S* to = a.quantized == nullptr ? a.out + head * shape.d : nullptr;
    const Rows<T> copy{s.dq_copy, s.copy};
    const Rows<T> out = to == nullptr ? copy : write(to, s.window.out, s.dq_copy);
    for (int64_t group = 0; group < shape.n; group += kGroup) {
      weights(group);
      if (to != nullptr) fetch(to, s.next.out, group);
      weighted_sums(Weights<1, kGroup, T>{s.p}, v, shape.n, out.from(group), group_size(group),
                    shape.d, Factors<T>{s.inverse, 1}, Into::kCache);
    }
    if (to != nullptr) return finish(to, s.window.out, s.dq_copy);
    if constexpr (is_same_v<S, float>) {
      const Quantize quantize(a.quantizer);
      uint8_t* map = a.quantized + head * shape.d;
      for (int64_t t = 0; t < shape.n; ++t) quantize(map + s.window.out[t], copy[t], shape.d);
    }
  }

  // Computes backward of one head. grad_bias is the head's row of bias gradients.
  void backward(int64_t index, double* grad_bias) {
    begin(index);
    const S* from = a.grad_out + head * shape.d;
    S* to = a.grad_qkv + head * shape.d;
    const Rows<const T> g = read(from, s.window.out, s.g_copy);
    const Rows<T> dq = write(to, s.window.in, s.dq_copy);
    const Rows<T> dk = write(to + part, s.window.in, s.dk_copy);
    const Rows<T> dv = write(to + 2 * part, s.window.in, s.dv_copy);
    const T unit = 1;
    const bool past = streams();
    const Factors<T> scale{&a.scale, 0}, one{&unit, 0};
    for (int64_t group = 0; group < shape.n; group += kGroup) {
      const auto n = shape.n;
      const auto d = shape.d;
      const int64_t queries = group_size(group);
      const Weights<kGroup, 1, T> p{s.p}, ds{s.dp};
      const Weights<1, kGroup, T> ds_of_query{s.dp};
      const Into first = past ? Into::kMemory : Into::kCache;
      const Into into = group > 0 ? Into::kSum : first;
      weights(group);
      fetch(from, s.next.out, group);
      transpose(g.from(group), d, s.columns);
      probability_gradients();
      softmax_backward(group, grad_bias);
      if (!past) fetch(to + 2 * part, s.next.in, group);
      weighted_sums(p, g.from(group), queries, dv, n, d, one, into);
      if (!past) fetch(to + part, s.next.in, group);
      weighted_sums(ds, q.from(group), queries, dk, n, d, scale, into);
      if (!past) fetch(to, s.next.in, group);
      weighted_sums(ds_of_query, k, n, dq.from(group), queries, d, scale, first);
    }
    finish(to, s.window.in, s.dq_copy);
    finish(to + part, s.window.in, s.dk_copy);
    finish(to + 2 * part, s.window.in, s.dv_copy);
  }

  // Calls body(outer, head, end) for the heads [head, end) of each `outer`, over the items [begin,
  // end). Heads are the inner loop because the heads of a token are neighbours in memory.
  template <typename Body>
  void for_heads(int64_t begin, int64_t end, Body body) const {
    for (int64_t item = begin, next; item < end; item = next) {
      const int64_t outer = item / shape.heads;
      next = smaller((outer + 1) * shape.heads, end);
      body(outer, item % shape.heads, next - outer * shape.heads);
    }
  }

  void forward_range(int64_t begin, int64_t end) {
    for_heads(begin, end, [&](int64_t window, int64_t head, int64_t last) {
      enter(window);
      for (; head < last; ++head) forward(head);
    });
  }

  void backward_range(int64_t begin, int64_t end) {
    const int64_t row_windows = a.windows / a.bias_rows;
    for_heads(begin, end, [&](int64_t chunk, int64_t head, int64_t last) {
      const int64_t row = chunk % a.bias_rows * row_windows, first = chunk / a.bias_rows * a.chunk;
      backward_chunk(row + first, row + smaller(first + a.chunk, row_windows), head, last,
                     a.grad_bias + (chunk * shape.heads + head) * shape.table);
    });
    finish_streams();
  }

  // Takes windows [begin, end) and heads [first, last). grad_bias has one row for each of these
  // heads.
  void backward_chunk(int64_t begin, int64_t end, int64_t first, int64_t last, double* grad_bias) {
    const int64_t table = shape.pairs ? shape.n * shape.padded : 0;
    for (int64_t i = first * table; i < last * table; ++i) s.pair_grad[i] = 0;
    for (int64_t window = begin; window < end; ++window) {
      enter(window);
      for (int64_t h = first; h < last; ++h) backward(h, grad_bias + (h - first) * shape.table);
    }
    if (!shape.pairs) return;
    for (int64_t head = first; head < last; ++head) {
      fold_pairs(s.pair_grad + head * table, shape.padded, 0, shape.n,
                 grad_bias + (head - first) * shape.table);
    }
  }
};

// Calls run(attention). Nearly every call has windows of 16 tokens and heads of 32 channels. Loops
// of known lengths make such calls 5 to 20 % faster. But where rows are read in place from a map
// larger than the caches, known lengths were up to 20 % slower.
template <typename S, typename Run>
void with_attention(const WindowAttentionArgs<S>& args, void* scratch, Run run) {
  const bool usual = args.window_r * args.window_a == 16 && args.head_dim == 32;
  const bool copied = sizeof(S) < sizeof(float);
  if (usual && (copied || !Shape<0, 0>(args).far)) {
    run(Attention<S, 16, 32>(args, scratch));
  } else {
    run(Attention<S, 0, 0>(args, scratch));
  }
}

template <typename S>
void forward(const WindowAttentionArgs<S>& args, int64_t begin, int64_t end, void* scratch) {
  with_attention(args, scratch, [&](auto attention) { attention.forward_range(begin, end); });
}
template <typename S>
void backward(const WindowAttentionArgs<S>& args, int64_t begin, int64_t end, void* scratch) {
  with_attention(args, scratch, [&](auto attention) { attention.backward_range(begin, end); });
}

template <typename S>
int64_t scratch_bytes(const WindowAttentionArgs<S>& args) {
  Arena arena{nullptr};
  AttentionScratch<S>(arena, Shape<0, 0>(args));
  return arena.used;
}

template <typename S>
constexpr WindowAttentionKernels<S> kTable = {
    .scratch = scratch_bytes<S>, .forward = forward<S>, .backward = backward<S>};

}  // namespace

TIER_TABLE(WindowAttentionKernels<float>) = kTable<float>;
TIER_TABLE(WindowAttentionKernels<double>) = kTable<double>;
TIER_TABLE(WindowAttentionKernels<bfloat16>) = kTable<bfloat16>;

}  // namespace darswin
