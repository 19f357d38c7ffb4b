// The patch embedding: polar sampling followed by a linear layer, one ring of tokens at a time.
//
// The samples of a ring form a matrix (A, S_r * S_phi * C) that fits the second-level cache. The
// kernel makes the samples, multiplies them with the weight and drops them, so they never go to
// memory. Backward computes them again. The gradients of the samples do not go to memory either:
// the product hands them straight to the pixels.
#include "arena.h"
#include "polar_rows.h"
#include "polar_sampler.h"
#include "polar_scatter.h"

namespace darswin {
namespace {

// Products of matrices that are in the cache.
//
// A tile of the result stays in registers while a loop runs over the depth. Each step multiplies a
// few whole registers of b with a few single values of a. The tile is as large as the registers
// allow, so that every loaded value is used often.

// Computes c[i * c_row + n] += sum over k < depth of a[i * a_row + k * a_column] * b[k * b_row + n]
// for rows i < kRows and for kWide registers of n.
template <int kRows, int kWide, typename T>
[[gnu::noinline]] void add_tile(int64_t depth, const T* a, int64_t a_row, int64_t a_column,
                                const T* b, int64_t b_row, T* c, int64_t c_row) {
  constexpr int lanes = kLanes<T>;
  using V = Vector<T, lanes>;
  V sum[kRows][kWide];
  for (int i = 0; i < kRows; ++i) {
    for (int w = 0; w < kWide; ++w) sum[i][w] = load<V>(c + i * c_row + w * lanes);
  }
  for (int64_t k = 0; k < depth; ++k, a += a_column, b += b_row) {
    V row[kWide];
    for (int w = 0; w < kWide; ++w) row[w] = load<V>(b + w * lanes);
    for (int i = 0; i < kRows; ++i) {
      for (int w = 0; w < kWide; ++w) sum[i][w] += a[i * a_row] * row[w];
    }
  }
  for (int i = 0; i < kRows; ++i) {
    for (int w = 0; w < kWide; ++w) store(c + i * c_row + w * lanes, sum[i][w]);
  }
}

template <int kWide, typename T>
void add_columns(int64_t rows, int64_t depth, const T* a, int64_t a_row, int64_t a_column,
                 const T* b, int64_t b_row, T* c, int64_t c_row) {
  int64_t i = 0;
  for (; i + kTileRows <= rows; i += kTileRows) {
    add_tile<kTileRows, kWide>(depth, a + i * a_row, a_row, a_column, b, b_row, c + i * c_row,
                               c_row);
  }
  for (; i < rows; ++i) {
    add_tile<1, kWide>(depth, a + i * a_row, a_row, a_column, b, b_row, c + i * c_row, c_row);
  }
}

// Computes c (rows, columns) += a (rows, depth) * b (depth, columns). The rows of b and c are
// contiguous, and the number of columns is a multiple of the lanes. a may be transposed.
template <typename T>
void add_product(int64_t rows, int64_t columns, int64_t depth, const T* a, int64_t a_row,
                 int64_t a_column, const T* b, int64_t b_row, T* c, int64_t c_row) {
  constexpr int64_t lanes = kLanes<T>;
  constexpr int64_t most = 128;  // rows of a panel of b that stay in the first-level cache
  for (int64_t k = 0; k < depth; k += most) {
    const int64_t part = smaller(depth - k, most);
    const T *from = a + k * a_column, *panel = b + k * b_row;
    int64_t n = 0;
    for (; n + 3 * lanes <= columns; n += 3 * lanes) {
      add_columns<3>(rows, part, from, a_row, a_column, panel + n, b_row, c + n, c_row);
    }
    for (; n < columns; n += lanes) {
      add_columns<1>(rows, part, from, a_row, a_column, panel + n, b_row, c + n, c_row);
    }
  }
}

// The scratch memory of one thread.
template <typename T>
struct EmbedScratch {
  int64_t rings, sectors;
  int64_t depth, row, wide;  // samples of a token; the same, padded; padded features
  char *sampler, *scatter;
  T* samples;   // (A, row)
  T* products;  // (A, wide)
  T* grads;     // (A, D)
  int64_t bytes;

  EmbedScratch(const PolarSampleArgs<T>& a, const PolarEmbedArgs<T>& e, PolarPass pass,
               void* memory)
      : rings(a.num_radii / a.samples_r),
        sectors(a.num_azimuths / a.samples_a),
        depth(a.samples_r * a.samples_a * a.channels),
        row(round_up(depth, kRowUnit)),
        wide(round_up(e.features, kRowUnit)) {
    Arena arena{static_cast<char*>(memory)};
    sampler = arena.take<char>(pass == PolarPass::forward ? Sampler<T>::bytes(a) : 0);
    scatter = arena.take<char>(pass == PolarPass::backward_image ? Scatter<T>::bytes(a) : 0);
    samples = arena.take<T>(sectors * row + kRowUnit);
    products = arena.take<T>(sectors * wide);
    grads = arena.take<T>(sectors * e.features);
    bytes = arena.used;
  }
};

template <typename T>
void embed(const PolarSampleArgs<T>& a, const PolarEmbedArgs<T>& e, int64_t begin, int64_t end,
           void* scratch) {
  const EmbedScratch<T> s(a, e, PolarPass::forward, scratch);
  Sampler<T> sampler(a, s.row, a.samples_a * a.channels, s.sampler);
  // The product goes straight into the output if rows of the output are whole registers of the type
  // used for computing.
  const bool in_place = !a.narrow && e.features == s.wide;
  for (int64_t item = begin; item < end; ++item) {
    const int64_t first = item * s.sectors * e.features;
    T* products = in_place ? static_cast<T*>(a.out) + first : s.products;
    sampler.ring(item / s.rings, item % s.rings, s.samples);
    for (int64_t t = 0; t < s.sectors; ++t) {
      T* to = products + t * s.wide;
      if (e.bias != nullptr) copy(e.bias, e.features, to);
      for (int64_t f = e.bias != nullptr ? e.features : 0; f < s.wide; ++f) to[f] = 0;
    }
    add_product(s.sectors, s.wide, s.depth, s.samples, s.row, 1, e.transposed, s.wide, products,
                s.wide);
    for (int64_t t = 0; t < s.sectors && !in_place; ++t) {
      with_output_type(a, [&]<typename E>() {
        copy(s.products + t * s.wide, e.features, static_cast<E*>(a.out) + first + t * e.features);
      });
    }
  }
}

// Returns the gradients (A, D) of a ring's tokens, in the type used for computing.
template <typename T>
const T* ring_grads(const PolarSampleArgs<T>& a, const PolarEmbedArgs<T>& e, int64_t item,
                    const EmbedScratch<T>& s) {
  const int64_t count = s.sectors * e.features;
  if (!a.narrow) return static_cast<const T*>(a.grad_out) + item * count;
  with_output_type(a, [&]<typename E>() {
    copy(static_cast<const E*>(a.grad_out) + item * count, count, s.grads);
  });
  return s.grads;
}

template <typename T>
void backward_weight(const PolarSampleArgs<T>& a, const PolarEmbedArgs<T>& e, int64_t begin,
                     int64_t end, T* weight, double* bias, void* scratch) {
  const EmbedScratch<T> s(a, e, PolarPass::forward, scratch);
  Sampler<T> sampler(a, s.row, a.samples_a * a.channels, s.sampler);
  for (int64_t item = begin; item < end; ++item) {
    const T* grads = ring_grads(a, e, item, s);
    sampler.ring(item / s.rings, item % s.rings, s.samples);
    add_product(e.features, s.row, s.sectors, grads, 1, e.features, s.samples, s.row, weight,
                s.row);
    for (int64_t t = 0; t < s.sectors; ++t) {
#pragma omp simd
      for (int64_t f = 0; f < e.features; ++f) bias[f] += grads[t * e.features + f];
    }
  }
}

// Computes the gradients of a ring's samples, (A, row), in s.samples.
template <typename T>
void sample_grads(const PolarSampleArgs<T>& a, const PolarEmbedArgs<T>& e, int64_t item,
                  const EmbedScratch<T>& s) {
  for (int64_t n = 0; n < s.sectors * s.row; ++n) s.samples[n] = 0;
  add_product(s.sectors, s.row, e.features, ring_grads(a, e, item, s), e.features, 1, e.weight,
              s.row, s.samples, s.row);
}

template <typename T>
void backward_samples(const PolarSampleArgs<T>& a, const PolarEmbedArgs<T>& e, int64_t begin,
                      int64_t end, void* scratch) {
  const EmbedScratch<T> s(a, e, PolarPass::backward_samples, scratch);
  for (int64_t item = begin; item < end; ++item) {
    sample_grads(a, e, item, s);
    for (int64_t t = 0; t < s.sectors; ++t) {
      copy(s.samples + t * s.row, s.depth, e.grad_samples + (item * s.sectors + t) * s.depth);
    }
  }
}

template <typename T>
void backward_image(const PolarSampleArgs<T>& args, const PolarEmbedArgs<T>& e, int64_t begin,
                    int64_t end, void* scratch) {
  const EmbedScratch<T> s(args, e, PolarPass::backward_image, scratch);
  PolarSampleArgs<T> a = args;
  a.narrow = false;  // the gradients of the samples are of type T
  const int64_t piece = a.samples_a * a.channels;
  for (int64_t b = begin; b < end; ++b) {
    Scatter<T> scatter(a, b, 0, s.scatter);
    for (int64_t ring = 0; ring < s.rings; ++ring) {
      sample_grads(args, e, b * s.rings + ring, s);
      scatter.ring(ring, [&](int64_t n, T* to) {
        read_row(a, s.samples, Row{n * piece, s.row, a.channels, 1}, to);
      });
    }
    scatter.finish();
  }
}

template <typename T>
int64_t scratch_bytes(const PolarSampleArgs<T>& a, const PolarEmbedArgs<T>& e, PolarPass pass) {
  return EmbedScratch<T>(a, e, pass, nullptr).bytes;
}

template <typename T>
constexpr PolarEmbedKernels<T> kTable = {.scratch = scratch_bytes<T>,
                                         .forward = embed<T>,
                                         .backward_weight = backward_weight<T>,
                                         .backward_samples = backward_samples<T>,
                                         .backward_image = backward_image<T>};

}  // namespace

TIER_TABLE(PolarEmbedKernels<float>) = kTable<float>;
TIER_TABLE(PolarEmbedKernels<double>) = kTable<double>;

}  // namespace darswin
