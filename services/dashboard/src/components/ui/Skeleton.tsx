interface SkeletonProps {
  readonly lines?: number;
}

/** Stands where something will be once the service has told it. */
export function Skeleton({ lines = 2 }: SkeletonProps) {
  return (
    <div class="skeleton" aria-hidden="true">
      {Array.from({ length: lines }, (_, index) => (
        <i key={index} />
      ))}
    </div>
  );
}
