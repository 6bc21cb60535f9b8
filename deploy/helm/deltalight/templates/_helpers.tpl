{{- define "deltalight.selector" -}}
app.kubernetes.io/name: deltalight
app.kubernetes.io/instance: {{ .root.Release.Name }}
app.kubernetes.io/component: {{ .component }}
{{- end }}

{{- define "deltalight.labels" -}}
{{ include "deltalight.selector" . }}
app.kubernetes.io/version: {{ .root.Chart.AppVersion | quote }}
app.kubernetes.io/managed-by: {{ .root.Release.Service }}
{{- end }}

{{- define "deltalight.image" -}}
image: {{ printf "%s:%s" .Values.image.repository (.Values.image.tag | default .Chart.AppVersion) | quote }}
imagePullPolicy: {{ .Values.image.pullPolicy }}
{{- end }}

{{- define "deltalight.pod" -}}
automountServiceAccountToken: false
{{- with .Values.imagePullSecrets }}
imagePullSecrets: {{- toYaml . | nindent 2 }}
{{- end }}
securityContext:
  runAsNonRoot: true
  runAsUser: 10001
  runAsGroup: 10001
  fsGroup: 10001
  fsGroupChangePolicy: OnRootMismatch
  seccompProfile: {type: RuntimeDefault}
initContainers:
  # A secret key must be its owner's alone, and a volume of a Secret is its group's too.
  - name: keys
    {{- include "deltalight.image" . | nindent 4 }}
    command: [install, -m, "400", /run/secrets/fleet/fleet.key, /run/secrets/fleet/fleet.key_secret, /run/deltalight]
    {{- include "deltalight.container" . | nindent 4 }}
    resources:
      requests: {cpu: 10m, memory: 16Mi}
      limits: {memory: 64Mi}
    volumeMounts:
      - {name: keys, mountPath: /run/deltalight}
      - {name: fleet, mountPath: /run/secrets/fleet, readOnly: true}
{{- end }}

{{- define "deltalight.container" -}}
securityContext:
  allowPrivilegeEscalation: false
  readOnlyRootFilesystem: true
  capabilities: {drop: [ALL]}
{{- end }}

{{- define "deltalight.mounts" -}}
- {name: tmp, mountPath: /tmp}
- {name: cache, mountPath: /home/deltalight/.cache}
- {name: data, mountPath: /var/lib/deltalight}
- {name: keys, mountPath: /run/deltalight, readOnly: true}
{{- end }}

{{- define "deltalight.volumes" -}}
- {name: tmp, emptyDir: {}}
- {name: cache, emptyDir: {}}
- {name: keys, emptyDir: {medium: Memory}}
- name: data
  persistentVolumeClaim:
    claimName: {{ .Values.data.existingClaim | default (printf "%s-data" .Release.Name) }}
- name: fleet
  secret:
    secretName: {{ .Values.existingSecret }}
    items:
      - {key: fleet.key, path: fleet.key}
      - {key: fleet.key_secret, path: fleet.key_secret}
{{- end }}

{{- define "deltalight.rayVolumes" -}}
- {name: shm, emptyDir: {medium: Memory, sizeLimit: 256Mi}}
- name: ray-token
  secret:
    secretName: {{ .Values.existingSecret }}
    items: [{key: ray_token, path: ray_token}]
{{- end }}

{{- define "deltalight.rayMounts" -}}
- {name: shm, mountPath: /dev/shm}
- {name: ray-token, mountPath: /run/secrets/ray, readOnly: true}
{{- end }}

{{- define "deltalight.env" -}}
- {name: DELTALIGHT_LOG_FORMAT, value: json}
- {name: DELTALIGHT_KEYS__NAME, value: fleet}
- {name: DELTALIGHT_KEYS__FOLDER, value: /run/deltalight}
- name: POD_IP
  valueFrom: {fieldRef: {fieldPath: status.podIP}}
{{- end }}

{{- define "deltalight.rayEnv" -}}
- {name: RAY_AUTH_MODE, value: token}
- {name: RAY_AUTH_TOKEN_PATH, value: /run/secrets/ray/ray_token}
- {name: RAY_worker_niceness, value: "0"}
{{- end }}

{{/* Names under which browsers and pods open the page; a probe uses the pod's address. */}}
{{- define "deltalight.hosts" -}}
{{- $hosts := .Values.web.allowedHosts }}
{{- if .Values.ingress.enabled }}
{{- $hosts = append $hosts .Values.ingress.host }}
{{- end }}
{{- range $service := list "web" "keeper" }}
{{- $name := printf "%s-%s" $.Release.Name $service }}
{{- $inside := printf "%s.%s" $name $.Release.Namespace }}
{{- $hosts = concat $hosts (list $name $inside (printf "%s.svc" $inside) (printf "%s.svc.cluster.local" $inside)) }}
{{- end }}
{{- toJson $hosts }}
{{- end }}

{{- define "deltalight.webEnv" -}}
- {name: DELTALIGHT_API__HOST, value: 0.0.0.0}
- {name: DELTALIGHT_API__ALLOWED_HOSTS, value: {{ include "deltalight.hosts" . | quote }}}
- {name: DELTALIGHT_API__TOKEN_FILE, value: /run/secrets/tokens/control_token}
- {name: DELTALIGHT_API__VIEW_TOKEN_FILE, value: /run/secrets/tokens/view_token}
# All requests come from the ingress controller.
- {name: DELTALIGHT_API__REQUESTS_PER_S, value: "1000"}
- name: DELTALIGHT_API__DATABASE
  valueFrom: {secretKeyRef: {name: {{ .Values.existingSecret }}, key: database}}
{{- with .Values.objectStore }}
{{- if .assets }}
- {name: DELTALIGHT_API__ASSETS, value: {{ .assets | quote }}}
{{- end }}
{{- if .endpoint }}
- {name: AWS_ENDPOINT_URL, value: {{ .endpoint | quote }}}
{{- end }}
{{- if .existingSecret }}
{{- $secret := .existingSecret }}
{{- range list "AWS_ACCESS_KEY_ID" "AWS_SECRET_ACCESS_KEY" }}
- name: {{ . }}
  valueFrom: {secretKeyRef: {name: {{ $secret }}, key: {{ . }}}}
{{- end }}
{{- end }}
{{- end }}
{{- end }}

{{- define "deltalight.webProbes" -}}
startupProbe:
  httpGet: {path: /api/v1/health, port: page}
  periodSeconds: 5
  failureThreshold: 60
livenessProbe:
  httpGet: {path: /api/v1/health, port: page}
  periodSeconds: 20
  timeoutSeconds: 8
  failureThreshold: 6
readinessProbe:
  httpGet: {path: /api/v1/ready, port: page}
  periodSeconds: 5
  timeoutSeconds: 5
{{- end }}

{{- define "deltalight.tokens" -}}
- name: tokens
  secret:
    secretName: {{ .Values.existingSecret }}
    items:
      - {key: control_token, path: control_token}
      - {key: view_token, path: view_token}
{{- end }}
