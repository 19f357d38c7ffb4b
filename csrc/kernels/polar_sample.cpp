// Polar bilinear sampling.
//
// Forward goes through the radii of an image and samples the points of each radius. polar_points.h
// computes the positions of the points. A small image is sampled from a packed copy in the cache, a
// large image directly (polar_image.h).
//
// Backward has two halves. The gradient of the image adds every point to four pixels, which other
// points share. So each thread owns a band of rows of an image and adds to them in the order of the
// points. The sums therefore do not depend on the number of bands. The gradient of the lens is a
// sum over each radius. Only the offsets have a gradient for each point.
//
// A point outside the image samples zeros and has no gradient. The same holds if its position is
// NaN or infinite.
#include "polar_rows.h"
#include "polar_sampler.h"
#include "polar_scatter.h"

namespace darswin {
namespace {

template <typename T>
void sample(const PolarSampleArgs<T>& a, int64_t begin, int64_t end, void* scratch) {
  T* samples = reinterpret_cast<T*>(static_cast<char*>(scratch) + Sampler<T>::bytes(a));
  const int64_t rings = a.num_radii / a.samples_r, piece = a.samples_a * a.channels;
  const int64_t values = a.num_azimuths * a.channels + 3;  // of a radius, with three spare
  Strides strides = output_strides(a);
  if (a.narrow) {  // float samples are converted row by row
    strides.row = values;
    (a.tokens ? strides.sector : strides.channel) = a.tokens ? piece : a.num_azimuths;
  }
  Sampler<T> sampler(a, strides, scratch);
  const auto sample_ring = [&](int64_t b, int64_t ring, int64_t channel) {
    const int64_t first = ring * a.samples_r;
    if (!a.narrow) {
      const int64_t start = output_start(a, b, first) + channel * strides.channel;
      return sampler.ring(ring, static_cast<T*>(a.out) + start);
    }
    sampler.ring(ring, samples);
    for (int64_t n = 0; n < a.samples_r; ++n) {
      write_row(a, b, first + n, channel, sampler.channels, samples + n * values);
    }
  };
  // The rings of an image, for the channels that the sampler takes at a time.
  for (int64_t item = begin, last; item < end; item = last) {
    const int64_t b = item / rings;
    last = smaller(end, (b + 1) * rings);
    for (int64_t channel = 0; channel < a.channels; channel += sampler.channels) {
      sampler.take(b, channel);
      for (int64_t k = item; k < last; ++k) sample_ring(b, k % rings, channel);
    }
  }
}

template <typename T>
void backward_image(const PolarSampleArgs<T>& a, int64_t begin, int64_t end, void* scratch) {
  for (int64_t item = begin; item < end; ++item) {
    const int64_t b = item / a.bands;
    Scatter<T> scatter(a, b, item % a.bands, scratch);
    scatter.add();
    scatter.finish();
  }
}

// Computes d(loss)/d(x, y) of a point, summed over its channels.
template <typename T, typename E>
void slope(const Corners<T, E>& corners, const T* grad, T right, T lower, T* gx, T* gy) {
  Vector<T, 4> sums{};  // of the corners, over the channels
  for (int64_t c = 0; c < corners.args.channels; ++c) sums += grad[c] * corners.values(c);
  *gx = (sums[1] - sums[0]) * (1 - lower) + (sums[3] - sums[2]) * lower;
  *gy = (sums[2] - sums[0]) * (1 - right) + (sums[3] - sums[1]) * right;
}

template <typename T>
struct LensScratch {
  RandomWords random;
  double across[kPlaces], down[kPlaces], shift[kPlaces];
  double x[kPlaces], y[kPlaces];  // of points relative to the center, before the matrix
  DirectPlaces<T> places;
};

template <typename T>
constexpr int64_t lens_bytes() {
  return round_up(sizeof(LensScratch<T>), 64);
}

template <typename T>
void backward_lens(const PolarSampleArgs<T>& a, int64_t begin, int64_t end, void* scratch) {
  auto& points = *static_cast<LensScratch<T>*>(scratch);
  DirectPlaces<T>& places = points.places;
  T* grads = reinterpret_cast<T*>(static_cast<char*>(scratch) + lens_bytes<T>());
  for (int64_t item = begin * a.samples_r; item < end * a.samples_r; ++item) {
    const int64_t b = item / a.num_radii, i = item % a.num_radii;
    double* sums = a.grad_lens + item * kLensSums;
    T* grad_offsets = a.grad_offsets == nullptr
                          ? nullptr
                          : a.grad_offsets + b * a.offsets_stride + i * a.num_azimuths;
    read_points(a, b, i, 0, a.num_azimuths, grads);
    for (int64_t j = 0; j < a.num_azimuths; j += kBlock) {
      const int64_t count = smaller(kBlock, a.num_azimuths - j);
      locate(a, b, i, j, count, points.random, [&](int64_t k, const Points& p) {
        place<false>(a, a.image_stride + 2, p, k, places);
        // A radius that was clamped at 0 does not move.
        store(points.across + k, select(p.clamped, Doubles{}, p.across));
        store(points.down + k, select(p.clamped, Doubles{}, p.down));
        store(points.shift + k, p.shift);
        if (a.affine == nullptr) return;
        store(points.x + k, p.radius * p.cos);
        store(points.y + k, p.radius * p.sin);
      });
      with_pixel_type<T>(a.pixel, [&]<typename E>() {
        for (int64_t k = 0; k < count; ++k) {
          const Corners<T, E> corners(a, b, places.column[k], places.row[k]);
          if (corners.outside()) continue;
          T gx, gy;
          slope(corners, grads + (j + k) * gradient_step(a), places.right[k], places.lower[k], &gx,
                &gy);
          const double along = gx * points.across[k] + gy * points.down[k], shift = points.shift[k];
          sums[kAcross] += gx;
          sums[kDown] += gy;
          sums[kAlong] += along;
          sums[shift < 0 ? kInward : kOutward] += along * shift;
          if (a.affine != nullptr) {
            sums[kAffine] += gx * points.x[k];
            sums[kAffine + 1] += gx * points.y[k];
            sums[kAffine + 2] += gy * points.x[k];
            sums[kAffine + 3] += gy * points.y[k];
          }
          if (grad_offsets != nullptr) {
            grad_offsets[j + k] += gx;
            grad_offsets[a.num_radii * a.num_azimuths + j + k] += gy;
          }
        }
      });
    }
  }
}

template <typename T>
int64_t scratch_bytes(const PolarSampleArgs<T>& a, PolarPass pass) {
  if (pass == PolarPass::forward) return Sampler<T>::bytes(a) + a.samples_r * row_bytes(a);
  if (pass == PolarPass::backward_image) return Scatter<T>::bytes(a);
  return lens_bytes<T>() + row_bytes(a);
}

template <typename T>
constexpr PolarSampleKernels<T> kTable = {.directions = directions,
                                          .scratch = scratch_bytes<T>,
                                          .forward = sample<T>,
                                          .backward_image = backward_image<T>,
                                          .backward_lens = backward_lens<T>};

}  // namespace

TIER_TABLE(PolarSampleKernels<float>) = kTable<float>;
TIER_TABLE(PolarSampleKernels<double>) = kTable<double>;

}  // namespace darswin
