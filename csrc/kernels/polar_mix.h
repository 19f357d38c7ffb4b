// The forward pass of polar_to_image: mixes the four tokens of each pixel.
#pragma once

#include "../polar_to_image.h"
#include "convert.h"
#include "polar_plan.h"

namespace darswin {
namespace {

// Mixes kL channels of a pixel at a time. `fixed` is the number of channels, or 0 if only the call
// knows it. Multiplying by a variable number four times would take longer than the rest of the work
// on a pixel with few channels.
template <typename T, int64_t kL, int64_t fixed>
class Forward {
 public:
  using Args = PolarToImageArgs<T>;
  using Real = Arithmetic<T>;
  using V = Vector<Real, kL>;

  Forward(const Args& args, Workspace<T>& work) : a(args), work(work) {}

  int64_t channels() const { return fixed > 0 ? fixed : a.channels; }

  void row(int64_t b, int64_t y) {
    const int64_t pixels = a.height * a.width;
    tile = work.row(b, y);
    for (int64_t first = 0; first < a.width; first += kTile, ++tile) {
      const int64_t count = smaller(kTile, a.width - first), place = y * a.width + first;
      const T* map = a.x + b * a.rings * a.sectors * channels();
      if constexpr (fixed == 1) {
        single(map, count, a.out + b * pixels + place);
      } else if (a.tokens) {
        find_end(count);
        tokens(map, count, a.out + (b * pixels + place) * channels());
      } else {
        find_end(count);
        planes(map, count, a.out + b * channels() * pixels + place, pixels);
      }
    }
  }

 private:
  // Finds how many channels can be read, counted from the first channel of any token of the tile.
  void find_end(int64_t count) {
    readable = channels();
    if (channels() % kL == 0) return;  // every register lies inside its token
    IndexOf<Real> last = 0;
    for (int corner = 0; corner < 4; ++corner) {
      for (int64_t k = 0; k < count; ++k) {
        const IndexOf<Real> token = tile->token[corner][k];
        last = token > last ? token : last;
      }
    }
    readable = channels() * (a.rings * a.sectors - last);
  }

  // Mixes channel c of pixel k. If W is a register, it mixes the channels from c on.
  template <typename W>
  W mix(const T* map, int64_t k, int64_t c) const {
    if (!tile->known[k]) return W{};
    const W inner = tile->weight[0][k] * load<W>(map + channels() * tile->token[0][k] + c) +
                    tile->weight[1][k] * load<W>(map + channels() * tile->token[1][k] + c);
    const W outer = tile->weight[2][k] * load<W>(map + channels() * tile->token[2][k] + c) +
                    tile->weight[3][k] * load<W>(map + channels() * tile->token[3][k] + c);
    return inner + outer;
  }

  // Mixes the channels from c on, which may be fewer than a register. It reads whole registers as
  // long as they lie inside the map.
  V mix_last(const T* map, int64_t k, int64_t c) const {
    if (c + kL <= readable) return mix<V>(map, k, c);
    V v{};
    for (int64_t e = c; e < smaller(c + kL, channels()); ++e) v[e - c] = mix<Real>(map, k, e);
    return v;
  }

  // Mixes the only channel, for one register of pixels at a time.
  void single(const T* map, int64_t count, T* to) const {
    using Pixels = Vector<Real, kLanes<Real>>;
    const int64_t whole = round_up(count, kLanes<Real>);
    const auto product = [&](int corner, int64_t k) {
      const auto* at = tile->token[corner] + k;
      Pixels values;
      if constexpr (is_same_v<T, float>) {
        values = gathered(map, at);
      } else {
        for (int lane = 0; lane < kLanes<Real>; ++lane) values[lane] = load<Real>(map + at[lane]);
      }
      return load<Pixels>(tile->weight[corner] + k) * values;
    };
    Real out[kTile];
    for (int64_t k = 0; k < whole; k += kLanes<Real>) {
      const Pixels inner = product(0, k) + product(1, k), outer = product(2, k) + product(3, k);
      const auto known = load<Vector<IndexOf<Real>, kLanes<Real>>>(tile->known + k);
      store(out + k, select(known, inner + outer, Pixels{}));
    }
    copy(out, count, to);
  }

  void tokens(const T* map, int64_t count, T* to) const {
    const T* end = to + count * channels();
    for (int64_t k = 0; k < count; ++k, to += channels()) {
      int64_t c = 0;
      for (; c + kL <= channels(); c += kL) store(to + c, mix<V>(map, k, c));
      if (c == channels()) continue;
      const V last = mix_last(map, k, c);
      if (end - (to + c) >= kL) {
        store(to + c, last);  // the next pixel overwrites the excess values
      } else {
        for (; c < channels(); ++c) store(to + c, last[c % kL]);
      }
    }
  }

  void planes(const T* map, int64_t count, T* to, int64_t stride) const {
    for (int64_t c = 0; c < channels(); c += kL) {
      const int64_t width = smaller(kL, channels() - c);
      int64_t k = 0;
      if constexpr (is_same_v<Real, float>) {
        for (; k + kL <= count; k += kL) square(map, k, c, width, to + c * stride + k, stride);
      }
      for (; k < count; ++k) {
        const V v = mix_last(map, k, c);
        for (int64_t e = 0; e < width; ++e) store(to + (c + e) * stride + k, v[e]);
      }
    }
  }

  // Mixes up to kL channels of kL pixels, starting at pixel k and channel c.
  void square(const T* map, int64_t k, int64_t c, int64_t width, T* to, int64_t stride) const {
    V rows[kL];
    if (width == kL) {
#pragma GCC unroll 16
      for (int i = 0; i < kL; ++i) {
        // The planes lie far apart, so the hardware does not prefetch them.
        __builtin_prefetch(to + i * stride + kL, 1);
        rows[i] = mix<V>(map, k + i, c);
      }
      if constexpr (is_same_v<T, float>) return transpose_square(rows, to, stride);
    } else {
#pragma GCC unroll 16
      for (int i = 0; i < kL; ++i) rows[i] = mix_last(map, k + i, c);
    }
    float turned[kL * kL];
    transpose_square(rows, turned, kL);
    for (int64_t i = 0; i < width; ++i) store(to + i * stride, load<V>(turned + i * kL));
  }

  const Args& a;
  Workspace<T>& work;
  const Mix<Real>* tile = nullptr;
  int64_t readable = 0;
};

template <typename T, int64_t kL, int64_t fixed>
void forward_items(const PolarToImageArgs<T>& a, int64_t begin, int64_t end, void* memory) {
  Workspace<T> work(a, memory);
  Forward<T, kL, fixed> forward(a, work);
  const int64_t rows = rows_of_band(a);
  for (int64_t item = begin; item < end; ++item) {
    const int64_t band = item / a.batch;
    for (int64_t y = band * rows; y < smaller((band + 1) * rows, a.height); ++y) {
      forward.row(item % a.batch, y);
    }
  }
}

}  // namespace
}  // namespace darswin
