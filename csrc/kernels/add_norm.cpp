// Residual and layer norm in one pass over memory, in place.
//
// A row holds a token's features. It is small enough for the first cache, so memory sees it once,
// while three loops go over it: the sum with its mean, the squares of what is left, and the
// normalized row. Taking the mean off before squaring keeps the digits that a large mean would
// cost. Where rows are bfloat16, it is the rounded sum that is normalized.
#include "kernels.h"
#include "simd.h"

namespace darswin::TIER {
namespace {

constexpr int64_t kL = kLanes<float>;

// Lanes of V, which is Floats or float, as they are stored.
template <typename V>
inline V read(const float* from) {
  return load_bits<V>(from);
}
template <typename V>
inline V read(const bfloat16* from) {
  if constexpr (kSame<V, float>) {
    return widen(*from);
  } else {
    return widen_lanes(from);
  }
}
template <typename V>
inline void write(float* to, V v) {
  store_bits(to, v);
}
template <typename V>
inline void write(bfloat16* to, V v) {
  if constexpr (kSame<V, float>) {
    *to = narrow(v);
  } else {
    narrow_lanes(to, v);
  }
}

// body<V>(column) on whole registers of a row, and on the columns that are left.
template <typename Body>
inline void along(int64_t width, Body body) {
  int64_t c = 0;
  for (; c + kL <= width; c += kL) body.template operator()<Floats>(c);
  for (; c < width; ++c) body.template operator()<float>(c);
}

// The lanes' sum, by halves.
template <int kCount>
inline float total(Vector<float, kCount> v) {
  if constexpr (kCount == 2) {
    return v[0] + v[1];
  } else {
    struct {
      Vector<float, kCount / 2> lower, upper;
    } halves;
    __builtin_memcpy(&halves, &v, sizeof(v));
    return total<kCount / 2>(halves.lower + halves.upper);
  }
}

// A sum along a row: of the lanes, and of what is left.
struct Sum {
  Floats lanes{};
  float rest = 0;
  void add(Floats v) { lanes += v; }
  void add(float v) { rest += v; }
  float all() const { return total<kL>(lanes) + rest; }
};

template <typename S>
void add_norm_rows(const AddNormArgs<S>& a, int64_t begin, int64_t end) {
  const float width = static_cast<float>(a.width);
  for (int64_t row = begin; row < end; ++row) {
    S *x = a.x + row * a.width, *y = a.y + row * a.width;
    Sum values, squares;
    along(a.width, [&]<typename V>(int64_t c) {
      write(x + c, read<V>(x + c) + read<V>(y + c));
      values.add(read<V>(x + c));
    });
    const float mean = values.all() / width;
    along(a.width, [&]<typename V>(int64_t c) {
      const V left = read<V>(x + c) - mean;
      squares.add(left * left);
    });
    const float scale = 1 / __builtin_sqrtf(squares.all() / width + a.eps);
    along(a.width, [&]<typename V>(int64_t c) {
      const V unit = (read<V>(x + c) - mean) * scale;
      write(y + c, unit * read<V>(a.weight + c) + read<V>(a.bias + c));
    });
  }
}

}  // namespace

void add_norm(const AddNormArgs<float>& a, int64_t begin, int64_t end) {
  add_norm_rows(a, begin, end);
}
void add_norm(const AddNormArgs<bfloat16>& a, int64_t begin, int64_t end) {
  add_norm_rows(a, begin, end);
}

}  // namespace darswin::TIER
